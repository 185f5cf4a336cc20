"""How wrong sizes are of bodies that took no part in learning, and of the trial by another simulator.

    python -m validation held_out [--draws 3]

Of the bodies in validation/population.csv.gz 70 % are drawn at random, a calibration of either form is learned from
them, and the others are sized by the mean of their exams: as they are, each exam by itself, without the head's profile,
and with what somebody might know of them; then by classes of lumps. The trial's masses (validation/other_simulator.csv)
are sized by the calibrations that come with the program; its truth gives seats in diameters, the table in radii. Two
minutes of CPU; both tables are kept.
"""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tactile_bayes.api.size_calibration import rows_of_one_way
from tactile_bayes.declarations import replace
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.files.tables import read_table
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.learn.bodies import learn_population, size_errors
from tactile_bayes.size.learn.regression import PopulationTable, rows_of
from tactile_bayes.studies.population import population_table
from validation.common import Table, parser

HERE = Path(__file__).parent
LEARNED = 0.7
NORMAL_95 = 1.959964
HEADS = (
    "masses",
    "mean absolute error",
    "bias",
    "95 % intervals that cover",
    "SD of standardised errors",
    "half width",
)
KNOWN = {"stiffness known": ("stiffness_ratio",), "seat known": ("seat",), "both known": ("seat", "stiffness_ratio")}
FORMS = {"`solid`": True, "`eq6`": False}


def bodies_of(path: Path, normalise: str) -> PopulationTable:
    """Maps of one way to normalise of a table of `population`."""
    return population_table(rows_of_one_way(read_table(path, "population.table.json"), normalise)[1])


def population(normalise: str) -> PopulationTable:
    """Those that the shipped calibrations are learned from."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "population.csv"
        path.write_bytes(gzip.decompress((HERE / "population.csv.gz").read_bytes()))
        return bodies_of(path, normalise)


def shipped(name: str) -> BodyCalibration:
    """A calibration over bodies that comes with the program."""
    path = size_calibration_path(name)
    found = None if path is None else read_size_calibration(path)
    assert isinstance(found, BodyCalibration)
    return found


def errors(calibration: BodyCalibration, table: PopulationTable, known: Sequence[str] = ()) -> FloatArray:
    """(2, bodies) errors of ln d, and the variances stated."""
    found = size_errors(calibration, table, known=known)
    return np.stack([found.error, found.variance])


def figures(found: FloatArray) -> tuple[str, ...]:
    """Cells of a row."""
    error, sd = found[0], np.sqrt(found[1])
    off, covered = 100 * np.expm1(error), np.abs(error) < NORMAL_95 * sd
    share = f"{covered.sum()} of {len(off)}" if len(off) < 100 else f"{100 * covered.mean():.0f} %"
    spread = f"{np.abs(off).mean():.1f} ± {np.abs(off).std() / np.sqrt(len(off)):.1f} %"
    half = 100 * np.median(np.sinh(NORMAL_95 * sd))
    return f"{len(off):,}", spread, f"{off.mean():+.1f} %", share, f"{(error / sd).std():.2f}", f"{half:.1f} %"


def classes(table: PopulationTable) -> dict[str, BoolArray]:
    """Classes of lumps, by the first exam of each body."""
    table = rows_of(table, np.isin(np.arange(len(table)), np.unique(table.body, return_index=True)[1]))
    stiffness, seat = np.exp(table.unknowns["stiffness_ratio"]), table.unknowns["seat"]
    ratio, amplitude = np.exp(table.unknowns["depth_mm"]) / table.d_mm, np.exp(table.log_amplitude)
    return {
        "6 to 15 times as stiff as fat": stiffness < 15,
        "these, centred on the gland's surface": (stiffness < 15) & (seat == 0),
        "15 to 50 times": (stiffness >= 15) & (stiffness < 50),
        "50 times and more": stiffness >= 50,
        "deep, 1.4 d and more": ratio >= 1.4,
        "shallow, below 0.8 d": ratio < 0.8,
        "faint, amplitude below 0.1": amplitude < 0.1,
        "clear, 0.3 and more": amplitude >= 0.3,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print and keep both tables."""
    words = parser(__name__, __doc__)
    words.add_argument("--draws", type=int, default=3)
    given = words.parse_args(arguments)
    table, recipe = population("gain"), shipped("solid").recipe
    bodies = np.unique(table.body)
    found: dict[tuple[str, str], list[FloatArray]] = {}
    members: dict[str, list[BoolArray]] = {}
    for seed in range(1, given.draws + 1):
        taught = np.isin(table.body, np.random.default_rng(seed).permutation(bodies)[: int(LEARNED * len(bodies))])
        rest = rows_of(table, ~taught)
        without = replace(rest, profile=np.full((len(rest), 3), np.nan))
        one_by_one = replace(rest, body=np.arange(len(rest)))
        for form, residual in FORMS.items():
            learned = learn_population(rows_of(table, taught), recipe=recipe, residual=residual)
            ways = {"": errors(learned, rest), ", each exam by itself": errors(learned, one_by_one)}
            if residual:
                ways[", without the head's profile"] = errors(learned, without)
                ways |= {f", {way}": errors(learned, rest, known) for way, known in KNOWN.items()}
            for way, one in ways.items():
                found.setdefault((form, way), []).append(one)
        for name, chosen in classes(rest).items():
            members.setdefault(name, []).append(chosen)
    kept = Table("bodies-held-out", "set", "calibration", *HEADS)
    for (form, way), parts in found.items():
        kept.add(f"bodies held out{way}", form, *figures(np.concatenate(parts, axis=1)))
    for name, normalise in (("solid", "gain"), ("solid-mean", "mean"), ("eq6", "gain")):
        trial = bodies_of(HERE / "other_simulator.csv", normalise)
        for way, known in ({"": ()} | (KNOWN if name == "solid" else {})).items():
            title = f"trial by another simulator{', ' if way else ''}{way}"
            kept.add(title, f"`{name}`", *figures(errors(shipped(name), trial, known)))
    kept.keep()
    by_class = Table("bodies-by-class", "lumps", *HEADS, "bias, stiffness known", "covered, stiffness known")
    plain, told = (np.concatenate(found["`solid`", way], axis=1) for way in ("", ", stiffness known"))
    for name, masks in members.items():
        chosen = np.concatenate(masks)
        by_class.add(name, *figures(plain[:, chosen]), *figures(told[:, chosen])[2:4])
    by_class.keep()
