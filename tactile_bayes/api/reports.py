"""The page of an exam from Python."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tactile_bayes.api.arguments import door
from tactile_bayes.api.estimates import PooledSize, SizeEstimate, estimated, listed, of_one_mass, settings_of
from tactile_bayes.api.paths import PathLike, path_of
from tactile_bayes.errors import UsageError
from tactile_bayes.pipeline.exam_report import EstimatedMap, ExamFiles, Given, make_exam, read_exam
from tactile_bayes.pipeline.settings import Settings, refuse_checkpoint
from tactile_bayes.report.exam import Exam
from tactile_bayes.report.exam_files import PageFiles
from tactile_bayes.report.exam_words import headline


@door
def exam_report(
    files: Any,
    path: PathLike,
    *,
    pdf: PathLike | None = None,
    title: str = "",
    name: str = "",
    day: str = "",
    force: bool = False,
    **settings: Any,
) -> str:
    """Write one page of an exam as HTML, as ``tactile-bayes report`` does.

    Parameters
    ----------
    files
        Maps, estimates and pooled sizes, or the paths of their files; one, or a list. Several maps are repeats of one
        mass and are pooled. A path of an estimate (JSON or posterior) goes alone, or with the path of its map.
    path
        Usually ``*.html``.
    pdf
        Also print the page there, by an installed Chromium or WeasyPrint.
    title, name, day
        To print on the page; nothing is where they are not given. The day as YEAR-MONTH-DAY.
    **settings
        As of `estimate`; estimates that are given keep their own.

    Returns
    -------
    str
        The page's headline.

    Raises
    ------
    UsageError
        When files do not fit each other, settings are given for an estimate's file, nothing is installed that prints,
        or a file exists and `force` is false.
    BadDataError
        When a file is damaged or of another kind, or the maps are of different exams.
    """
    page = PageFiles(path_of(path), path_of(pdf), force)
    page.check()
    given = listed(files)
    if not given:
        raise UsageError("nothing was given to report; give maps, or an estimate")
    exam = _exam(given, Given(title, name, day), settings)
    page.write(exam)
    return headline(exam)


def _exam(given: Sequence[Any], words: Given, settings: dict[str, Any]) -> Exam:
    """The exam of files alone, or of what Python holds."""
    if all(isinstance(one, str | Path) for one in given):
        files = ExamFiles.sort([path_of(one) for one in given])
        if files.estimates and settings:
            raise UsageError(f"an estimate has settings of its own; leave out {next(iter(settings))}, or give the map")
        return read_exam(files, settings_of(settings), words)
    found, used = _estimates(given, settings)
    maps = [EstimatedMap(one.outcome.tactile_map, one.answer, one.outcome.provenance.scans) for one in found]
    return make_exam(maps, used, words)


def _estimates(given: Sequence[Any], settings: dict[str, Any]) -> tuple[tuple[SizeEstimate, ...], Settings]:
    """Estimates of all maps, and the settings that pool them."""
    if len(given) == 1 and isinstance(given[0], PooledSize):
        return given[0].maps, given[0].settings
    used = settings_of(settings)
    if len(given) > 1:
        refuse_checkpoint(used)
    found = of_one_mass(estimated(given, settings))
    return found, found[0].outcome.settings if len(found) == 1 else used
