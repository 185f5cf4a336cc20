"""Names of exams and masses of a campaign, and of the files in its output folder."""

from __future__ import annotations

from typing import Final

JOURNAL: Final = "campaign.journal"
EXAMS, MASSES, GROWTH = "exams", "masses", "growth"
"""Folders that hold one of each exam, of each mass pooled at a visit, and of each mass compared between visits."""
DONE, FAILURES, TRIAL, GROWN = "exams_done.csv", "failures.csv", "trial.csv", "growth.csv"
"""Tables beside them."""

SCAN, MAP, ESTIMATE, POSTERIOR = "scan.mcap", "map.nc", "estimate.json", "posterior.nc"
SHAPE, THUMBNAIL, MAP_FIGURE, SIZE_FIGURE = "shape.npz", "thumbnail.png", "map.png", "size.png"
SIZED, SIZED_FIGURE = "sized.json", "sized.png"
"""Files of an exam."""
POOLED, POOLED_DRAWS = "pooled.json", "pooled.nc"
"""Files of a mass at a visit."""
COMPARED, COMPARED_FIGURE = "compare.json", "compare.png"
"""Files of a mass over its visits."""
REPEATABILITY: Final = "repeatability.json"
"""Beside the folders, as the tables are."""


def mass_name(*, patient: str, visit: str, mass: str) -> str:
    """Name of a mass at a visit, which is also its folder's."""
    return f"{patient}.v{visit}.m{mass}"


def exam_name(of_mass: str, replicate: int | str) -> str:
    """Name of an exam of the mass that `mass_name` names, which is also its folder's."""
    return f"{of_mass}.r{replicate}"
