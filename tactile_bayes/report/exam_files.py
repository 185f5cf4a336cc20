"""The page of an exam as files: HTML, and printed to PDF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tactile_bayes.errors import UsageError
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.report.exam import Exam


@dataclass(frozen=True, slots=True)
class PageFiles:
    """Where the page of an exam goes.

    Parameters
    ----------
    html, pdf
        Files to write; no PDF where it is None.
    force
        Overwrite them.
    """

    html: Path
    pdf: Path | None = None
    force: bool = False

    def check(self) -> None:
        """Refuse, before any work is done, what could not be written.

        Raises
        ------
        UsageError
            When a file exists and `force` is false, both are one file, one has the suffix of another format, or nothing
            is installed that prints.
        """
        from tactile_bayes.files.atomic import refuse_existing
        from tactile_bayes.files.file_names import check_suffix, same_file
        from tactile_bayes.report.printed import find_printer

        check_suffix(self.html, "HTML")
        refuse_existing(self.html, force=self.force)
        if self.pdf is not None:
            if same_file(self.pdf, self.html):
                raise UsageError(f"{self.pdf} is page and PDF at once; choose another name for one of them")
            check_suffix(self.pdf, "PDF")
            refuse_existing(self.pdf, force=self.force)
            find_printer()

    def write(self, exam: Exam) -> None:
        """Write the page and its print: both of them, or none.

        Raises
        ------
        UsageError
            As of `check`, and when the page could not be printed.
        """
        from tactile_bayes.files.atomic import write_all
        from tactile_bayes.report.exam_page import exam_page
        from tactile_bayes.report.printed import find_printer

        page = exam_page(exam)
        files = {self.html: page.encode()}
        if self.pdf is not None:
            files[self.pdf] = find_printer()(page)
        write_all(files, force=self.force)
