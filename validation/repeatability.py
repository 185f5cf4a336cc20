"""How well a site's repeatability is learned from its repeats, and what intervals of sizes it makes.

    python -m validation repeatability spread [--sites 2000] [--only ROW]
    python -m validation repeatability scans DIR [--masses 12] [--spread 0.1] [--workers 1]

`spread`: sites at the level of ln d. Exam j of mass i gives mu_i + E_ij + e_ij; the maps' own SDs of e are log-normal
about 3 % (log-SD 0.4), what a body hides has an SD of 7 %. The site's file is learned by the program's own code. Single
maps are judged by the probability that their 95 % interval holds the truth, given the site's file, averaged over sites:
of a new mass, also by the whole posterior that the file sums up; of the masses that the file was learned from, by the
file and by one without that mass. The same for three maps pooled. Beside them: intervals without a file, by the
default's two priors (exams as alike as simulated ones; the paper's 15 %). Rows with masses that differ in their spread,
with one mass that is three and five times as uneven, and, as the negative control, with maps whose own errors are taken
for zero.

`scans`: the whole path. Masses are scanned three times by the solid model; in each exam the lump is a little larger or
smaller than it is, by a factor with this log-SD. `campaign run` does the rest, once by its own repeatability and once
with `--repeatability none`. The true spread is this one and that of simulated exams (about 4 %) together.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from tactile_bayes.declarations import replace
from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.draws import BetweenMaps
from tactile_bayes.size.learn.site import GRID, RepeatedExams, learn_repeatability
from validation.common import Table, parser, program, share

SEED = 20261124
MAP_SD, MAP_LOG_SD, BODY_SD = 0.03, 0.4, 0.07
SIMULATED = BetweenMaps(0.03)
"""About as the shipped `solid` has it: 2.5 %."""
PAPER = BetweenMaps()
BODIES = BODY_SD * ndtri((np.arange(64) + 0.5) / 64)


@dataclass(frozen=True)
class Row:
    """One kind of site.

    Parameters
    ----------
    masses, spread
        With three maps each, and the true SD of ln d between exams.
    apart
        Log-SD of the spread between masses; their mean square is that of `spread`.
    uneven
        Factor of the first mass's spread.
    noise_known
        Whether the maps' own errors are told.
    """

    masses: int
    spread: float
    maps: int = 3
    apart: float = 0.0
    uneven: float = 1.0
    noise_known: bool = True

    def __str__(self) -> str:
        more = f", log-SD {self.apart:g} between masses" if self.apart else ""
        more += f", one mass {self.uneven:g} times as uneven" if self.uneven != 1 else ""
        more += "" if self.noise_known else ", control: maps taken for exact"
        return f"{self.masses}, {100 * self.spread:g} %{more}"


ROWS = (
    *(Row(masses, spread) for masses in (5, 10, 20) for spread in (0.03, 0.08, 0.15)),
    *(Row(3, spread) for spread in (0.03, 0.08, 0.15)),
    *(Row(10, spread, apart=0.4) for spread in (0.03, 0.08, 0.15)),
    *(Row(10, 0.08, uneven=factor) for factor in (3.0, 5.0)),
    *(Row(10, spread, noise_known=False) for spread in (0.03, 0.15)),
)

HEADS = (
    "masses, true spread",
    "learned: median (90 % of sites)",
    "its 95 % interval holds it",
    "95 % intervals of sizes cover, half width",
    "no file, narrower interval",
    "no file, wider",
)
SHOWN = (
    "one map of a new mass (site's file)",
    "one map (default, this exam)",
    "one map (default, if exams differ by 15 %)",
)
"""What the last three columns are, of the figures of a site."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    words = parser(__name__, __doc__)
    commands = words.add_subparsers(dest="what", required=True)
    spread = commands.add_parser("spread")
    spread.add_argument("--sites", type=int, default=2000, help="a row")
    spread.add_argument("--only", type=int, action="append", choices=range(len(ROWS)))
    spread.add_argument("--keep", action="store_true", help="keep the table for docs/coverage.md")
    scans = commands.add_parser("scans")
    scans.add_argument("folder", type=Path)
    scans.add_argument("--masses", type=int, default=12)
    scans.add_argument("--spread", type=float, default=0.1)
    scans.add_argument("--workers", type=int, default=1)
    given = words.parse_args(arguments)
    if given.what == "spread":
        table = spreads([ROWS[i] for i in given.only or range(len(ROWS))], given.sites)
        if given.keep:
            table.keep()
    else:
        run_scans(given.folder, given.masses, given.spread, given.workers)
    return 0


# --- sites at the level of ln d ---


def spreads(rows: Sequence[Row], sites: int) -> Table:
    """What sites of each kind learn and how often sizes by it hold; the other figures are printed below the table."""
    table, more = Table("site-repeatability", *HEADS), []
    for row in rows:
        rng = np.random.default_rng([SEED, ROWS.index(row)])
        found = [_site(row, rng) for _ in range(sites)]
        columns = {name: np.array([one[name] for one in found], dtype=float) for name in found[0]}
        low, middle, high = (100 * np.quantile(columns["median"], q) for q in (0.05, 0.5, 0.95))
        cells = {name: _cell(columns, name) for name in columns if name.endswith(")")}
        learned = f"{middle:.1f} % ({low:.1f} to {high:.1f})", f"{100 * columns['held'].mean():.1f} %"
        table.add(str(row), *learned, *(cells.pop(name) for name in SHOWN))
        named, first = (100 * columns[name].mean() for name in ("named", "first"))
        more += [f"{row}: names a mass at {named:.1f} % of sites, the first at {first:.1f} %"]
        more += [f"  {name}: {cell}" for name, cell in cells.items()]
    print("\n".join(["", *more]))
    return table


def _cell(columns: dict[str, FloatArray], name: str) -> str:
    """Share of intervals that hold, and their half width where it is known."""
    half = columns.get(f"{name} half")
    width = "" if half is None else f", {100 * np.median(np.expm1(half)):.0f} %"
    return f"{columns[name].mean():.3f}{width}"


def _site(row: Row, rng: np.random.Generator) -> dict[str, float]:
    """One site: its file, and how probable it is that intervals of sizes hold the truth."""
    exams = [_exams(row, i, rng) for i in range(row.masses + 1)]
    new, exams = exams[-1], exams[:-1]
    told = exams if row.noise_known else [replace(one, noise=np.full(row.maps, 1e-12)) for one in exams]
    learned = learn_repeatability(told)
    found, prior = learned.repeatability, learned.repeatability.between_maps
    without = _without_last(told, prior)
    held = {
        "median": found.median,
        "held": found.low <= row.spread <= found.high,
        "named": bool(found.outlying),
        "first": "0" in found.outlying,
    }
    whole = half_width(GRID, learned.density, float(new.noise[0]))
    held["one map of a new mass (the whole posterior for the file)"] = _holds(float(new.centre[0]), whole)
    for name, exam, by in (
        ("one map of a new mass (site's file)", new, prior),
        ("one map of a mass of the file (site's file)", exams[-1], prior),
        ("one map of a mass of the file (file without it)", exams[-1], without),
        ("one map (default, this exam)", new, SIMULATED),
        ("one map (default, if exams differ by 15 %)", new, PAPER),
    ):
        noise = float(exam.noise[0])
        half = half_width(by.grid, by.density(), noise)
        held |= {name: _holds(float(exam.centre[0]), half), f"{name} half": half}
    held["three maps of a new mass (site's file)"] = _pooled_holds(prior, new)
    held["three maps of a mass of the file (site's file)"] = _pooled_holds(prior, exams[-1])
    held["three maps of a mass of the file (file without it)"] = _pooled_holds(without, exams[-1])
    return held


def _without_last(exams: list[RepeatedExams], otherwise: BetweenMaps) -> BetweenMaps:
    """What the site's file would be without its last mass; with all where too few are left."""
    return otherwise if len(exams) < 4 else learn_repeatability(exams[:-1]).repeatability.between_maps


def _exams(row: Row, index: int, rng: np.random.Generator) -> RepeatedExams:
    """Exams of one mass whose true ln d, but for what its body hides, is 0."""
    noise = np.exp(rng.normal(np.log(MAP_SD), MAP_LOG_SD, row.maps)) ** 2
    spread = row.spread * np.exp(rng.normal(0.0, row.apart) - row.apart**2)
    spread *= row.uneven if index == 0 else 1.0
    centre = rng.normal(0.0, spread, row.maps) + rng.normal(0.0, np.sqrt(noise))
    return RepeatedExams(str(index), str(index), centre, noise)


def half_width(grid: FloatArray, weights: FloatArray, noise: float) -> float:
    """Half width in ln d of the 95 % interval of one map: tau by its weights on a grid, all else normal."""
    sd = np.sqrt(BODY_SD**2 + noise + grid**2)
    return float(brentq(lambda half: 2 * weights @ ndtr(-half / sd) - 0.05, 1e-3, 10.0))


def _holds(centre: float, half: float) -> float:
    """Probability over bodies that an interval about this centre holds the truth."""
    return float(ndtr((half - centre) / BODY_SD) - ndtr((-half - centre) / BODY_SD))


def _pooled_holds(between: BetweenMaps, exams: RepeatedExams) -> float:
    """The same of the maps of a mass pooled, as `size.pooling` weighs them, over fixed draws of the body."""
    weights, tau2 = between.density((exams.centre, exams.noise)), between.grid**2
    share_of = 1.0 / (exams.noise[:, None] + tau2)
    share_of /= share_of.sum(axis=0)
    mean = share_of.T @ exams.centre
    sd = np.sqrt(np.sum(share_of**2 * (exams.noise[:, None] + tau2), axis=0) + BODY_SD**2)
    at: FloatArray = ndtr((BODIES[:, None] - mean) / sd) @ weights
    return float(np.mean((at >= 0.025) & (at <= 0.975)))


# --- scans ---


def run_scans(folder: Path, masses: int, spread: float, workers: int) -> None:
    """Simulate, run the campaign twice, count."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "exams.csv").exists():
        _write_scans(folder, masses, spread)
    truth = json.loads((folder / "truth.json").read_text())
    for name, more in (("own", ()), ("none", ("--repeatability", "none"))):
        options = ("--method", "laplace", "--workers", workers)
        done = program("campaign", "run", "exams.csv", "-o", "out", *more, *options, cwd=folder)
        print(f"--repeatability {name}:\n{done.stdout}{done.stderr}", end="")
        _count(folder / "out" / "trial.csv", truth)


def _write_scans(folder: Path, masses: int, spread: float) -> None:
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.files.scan_mcap import write_scan
    from tactile_bayes.forward.simulate import simulate
    from tactile_bayes.studies.population import BodyPrior, Population

    bodies = BodyPrior(d_mm=(9.0, 20.0), depth_ratio=(0.56, 1.2))
    rows, truth = ["file,patient,visit,mass,replicate"], {}
    for index in range(masses):
        rng = np.random.default_rng([SEED, index])
        for j, scene in enumerate(Population(scans=3, seed=SEED, bodies=bodies).scenes(index), start=1):
            lump = scene.solid_lumps[0]
            truth[f"{index:02}"] = lump.d_mm
            other = replace(lump, d_mm=lump.d_mm * float(np.exp(rng.normal(0.0, spread))))
            scene = replace(scene, solid_lumps=(other,))
            scan = simulate(scene, rng=np.random.default_rng([SEED, scene.seed])).scan
            write_scan(folder / f"{index:02}-{j}.mcap", scan, provenance=Provenance("benchmark", {}), force=True)
            rows.append(f"{index:02}-{j}.mcap,{index:02},1,1,{j}")
    (folder / "truth.json").write_text(json.dumps(truth))
    (folder / "exams.csv").write_text("\n".join(rows) + "\n")


def _count(table: Path, truth: dict[str, float]) -> None:
    """How many intervals of the trial's table hold the true size, by modality."""
    with table.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["status"] == "detected"]
    for modality in sorted({row["modality"] for row in rows}):
        sized = [row for row in rows if row["modality"] == modality]
        inside = [float(row["low_mm"]) <= truth[row["patient"]] <= float(row["high_mm"]) for row in sized]
        half = [(float(row["high_mm"]) - float(row["low_mm"])) / 2 / float(row["size_mm"]) for row in sized]
        print(f"  {modality}: {sum(inside)} of {len(inside)} hold, {share(inside)}, ", end="")
        print(f"half width {100 * np.median(half):.0f} %")
