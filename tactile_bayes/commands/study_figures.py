"""Figures of `study`: where they go, the frames that a user measured, and what is drawn from either model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tactile_bayes.forward.plane.measured import MeasuredFrame
    from tactile_bayes.forward.plane.study import Fit, StudyRow, StudySettings
    from tactile_bayes.forward.solid.study import SolidSettings

_FRAMES_SCHEMA = "measured_frames.table.json"


def read_frames(path: Path) -> list[MeasuredFrame]:
    """The frames of a table, one for each place of the head, in the order in which they first appear."""
    import numpy as np

    from tactile_bayes.errors import BadDataError
    from tactile_bayes.files.tables import read_table
    from tactile_bayes.forward.plane.measured import MeasuredFrame

    columns = read_table(path, _FRAMES_SCHEMA).columns
    place = np.array([0.0 if x is None else x for x in columns["x_c_mm"]])
    s, pressure = np.array(columns["s_mm"]), np.array(columns["pressure_kpa"])
    try:
        return [MeasuredFrame(x, s[place == x], pressure[place == x]) for x in dict.fromkeys(place.tolist())]
    except BadDataError as error:
        raise error.at(path) from None


def figure_paths(folder: Path, *, model: str) -> list[Path]:
    """Where figures 5 to 8 go, and in two dimensions the frames of four lumps."""
    paths = [folder / f"figure_{number}.png" for number in (5, 6, 7, 8)]
    return [*paths, folder / "four_lumps.png"] if model == "plane-strain" else paths


def prepare_figures(folder: Path, *, model: str, force: bool) -> None:
    """Make the directory, and stop before any work where a figure is in the way."""
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.atomic import refuse_existing

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} cannot be made a directory ({error.strerror}); choose another name") from None
    for path in figure_paths(folder, model=model):
        refuse_existing(path, force=force)


def draw_figures(
    rows: list[StudyRow],
    settings: StudySettings | SolidSettings,
    folder: Path,
    *,
    seat: float,
    fit: Fit,
    phantom: tuple[float, float] | None,
    frames: list[MeasuredFrame],
    force: bool,
) -> list[str]:
    """Draw figures 5 to 8 of the paper; say where they are and what was found for them.

    Parameters
    ----------
    seat
        Of the lumps that are drawn and not in the table.
    fit
        Of Eq 5 to a line, for the plane-strain model.
    phantom, frames
        Lump and measured frames of figure 6; None and none for the paper's phantom.
    """
    from tactile_bayes.forward.plane.study import StudySettings

    if isinstance(settings, StudySettings):
        from tactile_bayes.forward.plane.measured import compare_frames
        from tactile_bayes.forward.plane.tables import PHANTOMS
        from tactile_bayes.report.study_figures import frames_text, lookalikes_text, study_figures

        paths = figure_paths(folder, model="plane-strain")
        d, h = phantom or PHANTOMS["phantom 12.5 mm"]
        compared = compare_frames(frames, d_mm=d, depth_ratio=h, seat=seat, settings=settings) if frames else []
        found = study_figures(rows, settings, paths, seat=seat, fit=fit, phantom=(d, h), measured=compared, force=force)
        where = f"figures 5 to 8 and the frames of four lumps are in {folder}"
        return [lookalikes_text(found), *frames_text(compared), where]
    from tactile_bayes.report.solid_figures import solid_figures
    from tactile_bayes.studies.raster import fit_raster, raster_map

    paths = figure_paths(folder, model="solid")
    solid_figures(rows, settings, paths, seat=seat, fit=fit_raster, build=raster_map, force=force)
    return [f"figures 5 to 8 are in {folder}"]
