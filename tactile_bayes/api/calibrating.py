"""Size calibrations from lumps of known size, and a site's repeatability from its exams."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tactile_bayes.api.arguments import PathLike, door, output_path, plain, required_path, table_of, takes
from tactile_bayes.api.repeatability import exams_in, learn_from_exams
from tactile_bayes.api.size_calibration import learn
from tactile_bayes.options import LearnOptions
from tactile_bayes.size.pooling import Calibration, Repeatability

if TYPE_CHECKING:
    import pandas


@door
@takes(LearnOptions)
def calibrate_size(
    table: PathLike | pandas.DataFrame,
    *,
    correct: PathLike | None = None,
    path: PathLike | None = None,
    force: bool = False,
    **options: Any,
) -> Calibration:
    """Learn a size calibration from lumps of known size.

    Parameters
    ----------
    table
        A row for each lump: d_mm, amplitude, sigma_x_mm...; or a table of `population`, a row for each exam.
    correct
        Name or path of a calibration over bodies that the table's lumps correct; the table may also list map files.
    path
        Also write the calibration there.
    **options
        As of `tactile_bayes.options.LearnOptions`, by default as on the command line: form, fit, seed,
        least_stiffness_ratio, and normalise, background, fit_radius_mm, noise of the table's maps where it does not
        say; of a table of `population`, normalise: which rows to learn from.

    Returns
    -------
    calibration
        For ``estimate(..., size_calibration=...)``.

    Raises
    ------
    BadDataError
        Naming the table, the line, the column, the value and the way out.
    TypeError
        When a keyword is none of these.
    UsageError
        When a keyword's value cannot be one, or goes with another form.
    """
    asked = LearnOptions(**{name: plain(value) for name, value in options.items()})
    target = None if path is None else output_path(path, "JSON")
    learned = learn(table_of(table, "table"), asked, options, correct=None if correct is None else str(correct))
    if target is not None:
        learned.write(target, force=force)
    return learned.calibration


@door
def calibrate_repeatability(
    folder: PathLike, *, size_calibration: PathLike | None = None, path: PathLike | None = None, force: bool = False
) -> Repeatability:
    """Learn how far sizes of one mass lie apart between its exams at a site.

    Parameters
    ----------
    folder
        Of a ``campaign run`` with at least 3 masses that have repeated exams.
    size_calibration
        Calibration that the exams were sized by, where the name in their estimates does not lead to its file.
    path
        Also write it there.

    Returns
    -------
    Repeatability
        For ``estimate(..., repeatability=...)``: `median`, `low` and `high` of the spread, a share of the size.

    Raises
    ------
    BadDataError
        When there are too few masses with repeated exams, or the exams were sized by several calibrations.
    UsageError
        When the calibration's file is not found.
    """
    target = None if path is None else output_path(path, "JSON")
    given = None if size_calibration is None else str(size_calibration)
    learned = learn_from_exams(exams_in(required_path(folder, "folder")), size_calibration=given)
    if target is not None:
        learned.write(target, force=force)
    return learned.repeatability
