"""How often a mistake in a scan's arrangement is named: ``python -m validation arrangement``.

Every mistake is made in every exam, and the exam is checked as `map` checks it. The exams are those of
``validation lump_probability``, half of them with a lump, from clear to invisible; or the scans of a folder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.files.imports import read_arrays
from tactile_bayes.mapping.arrangement import check_scan
from tactile_bayes.mapping.convention import corrected
from tactile_bayes.presets import CORRECTIONS
from tactile_bayes.scans import ElementCalibration, PressureFrames, Scan, TrackerPoses
from validation.common import Table, parser
from validation.lump_probability_scenes import draw

SEED = 20281153
RIGHT = "none: as it is stated"
MENDED_BY = {
    **{name: {name} for name in CORRECTIONS},
    "quarter-turn": {"quarter-turn-back"},
    "quarter-turn-back": {"quarter-turn"},
    # By whatever turn the tracker is mounted.
    "lever-none": {"quarter-turn", "quarter-turn-back", "half-turn"},
}
ANSWERS = ("refused, named", "caution, named", "wrongly named", "contradiction", "not shown", "nothing said")


def mistaken(scan: Scan, mistake: str) -> Scan:
    """The scan as one gives it who makes a mistake."""
    if mistake == RIGHT:
        return scan
    if mistake == "scalar-last":
        wxyz = np.roll(scan.poses.quaternion_wxyz, -1, axis=1)
        return replace(scan, poses=TrackerPoses(scan.poses.time_s, scan.poses.position_mm, wxyz))
    if mistake != "transposed":
        return corrected(scan, [mistake])
    held = scan.element_calibration
    gain, offset, counts = (
        np.ascontiguousarray(array.swapaxes(-1, -2)).reshape(array.shape)
        for array in (held.gain_kpa_per_count, held.offset_kpa, scan.frames.counts)
    )
    calibration = ElementCalibration(gain, offset, held.saturation_count)
    return replace(scan, frames=PressureFrames(scan.frames.time_s, counts), element_calibration=calibration)


def answered(scan: Scan, mistake: str) -> str:
    """Which of `ANSWERS` the check gives."""
    check = check_scan(mistaken(scan, mistake), thorough=False)
    if check.too_short or (check.inconclusive and not check.contradicting):
        return "not shown"
    if check.contradicting:
        return "contradiction"
    if check.best is check.stated:
        return "nothing said"
    if mistake == RIGHT or not check.best.corrections or not set(check.best.corrections) <= MENDED_BY[mistake]:
        return "wrongly named"
    return "refused, named" if check.refused else "caution, named"


def scans(folder: Path | None, exams: int, seed: int) -> Iterator[Scan]:
    """Scans of a folder's arrays, or of simulated exams."""
    if folder is None:
        yield from (draw(index, seed=seed).scan() for index in range(exams))
    else:
        yield from (read_arrays(path) for path in sorted(folder.glob("*.npz")))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table as Markdown: mistakes by what is said of them."""
    words = parser(__name__, __doc__)
    words.add_argument("--exams", type=int, default=60)
    words.add_argument("--seed", type=int, default=SEED)
    words.add_argument("--scans", type=Path, help="folder of .npz in place of simulated exams")
    words.add_argument("--only", action="append", choices=(RIGHT, *CORRECTIONS), help="mistake; may be repeated")
    words.add_argument("--keep", action="store_true", help="keep the table for the documents")
    given = words.parse_args(arguments)
    said: Counter[tuple[str, str]] = Counter()
    mistakes = given.only or (RIGHT, *CORRECTIONS)
    for scan in scans(given.scans, given.exams, given.seed):
        said.update((mistake, answered(scan, mistake)) for mistake in mistakes)
    table = Table("arrangement" + ("-scans" if given.scans else ""), "mistake", *ANSWERS)
    for mistake in mistakes:
        table.add(mistake, *(str(said[mistake, answer]) for answer in ANSWERS))
    if given.keep:
        table.keep()
