"""Size calibrations from lumps of known size, and a site's repeatability from its exams."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tactile_bayes.api.arguments import PathLike, door, output_path, plain, required_path, table_of, takes
from tactile_bayes.api.repeatability import exams_in, learn_from_exams
from tactile_bayes.api.size_calibration import Learned, correct_size, is_population, learn_eq6, learn_population
from tactile_bayes.errors import UsageError
from tactile_bayes.files.tables import Sheet
from tactile_bayes.laboratory_options import LearnOptions
from tactile_bayes.progress import Progress
from tactile_bayes.size.pooling import Calibration, Repeatability

if TYPE_CHECKING:
    import pandas

_MAPS: Final = ("normalise", "background", "fit_radius_mm", "noise")  #: How a table's maps were made, if it is silent.


def learn(
    table: Path | Sheet,
    asked: LearnOptions,
    given: Collection[str],
    *,
    correct: str | None = None,
    against: Path | None = None,
    progress: Progress | None = None,
) -> Learned:
    """Learn a size calibration in the way that table and options ask for; those of another way are refused.

    `given`: names of the options that somebody gave; `correct`: name or path of the calibration to correct; `against`:
    lumps of another origin, for one over bodies.
    """
    declared = {name: getattr(asked, name) for name in _MAPS}
    if correct is not None:
        why = "is for learning a calibration; leave it out with --correct"
        _refuse(given, why, "form", "against", "fit", "least_stiffness_ratio", "figure")
        return correct_size(table, correct, declared, seed=asked.seed, progress=progress)
    if asked.form != "eq6" or is_population(table):
        why = "is for tables of lumps: a table of `population` fixes how its maps were made"
        _refuse(given, why, "fit", *_MAPS[1:], "least_stiffness_ratio", "figure", "seed")
        return learn_population(table, asked.form, asked.normalise, against=against)
    _refuse(given, "is for a table of `population`; leave it out", "against")
    ratio = asked.least_stiffness_ratio
    return learn_eq6(table, declared, fit=asked.fit, least_stiffness_ratio=ratio, seed=asked.seed, progress=progress)


def _refuse(given: Collection[str], why: str, *others: str) -> None:
    for name in others:
        if name in given:
            raise UsageError(f"--{name.replace('_', '-')} {why}")


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
        As of `tactile_bayes.laboratory_options.LearnOptions`, by default as on the command line: form, fit, seed,
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
