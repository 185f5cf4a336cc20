"""How well a site's phantoms correct a calibration, at simulated sites.

    python -m validation site_phantoms [--sites 200]

At each site all sizes are off by a shift and by a slope with the map's width, drawn from `SitePrior`, or by nothing.
Some bodies of validation/population.csv.gz that took no part in learning (see `held_out`) are its phantoms, one exam
each, and 20 others its patients. Printed: the patients' errors with the correction and without, and how many 95 %
intervals cover.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import LEAST_HARD_RATIO
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws
from tactile_bayes.size.learn.bodies import learn_population
from tactile_bayes.size.learn.regression import PopulationTable, rows_of
from tactile_bayes.size.learn.site import PhantomMap, SitePrior, correct_calibration
from validation.common import parser
from validation.held_out import LEARNED, NORMAL_95, errors, population, shipped

SEED, PATIENTS, DRAWS = 20261125, 20, 32
STATED = ("depth_mm", "seat", "stiffness_ratio")
SITES = ((5, True, 1.0), (20, True, 1.0), (5, False, 1.0), (20, False, 1.0), (5, True, 0.0))
"""Phantoms, whether their properties are stated, and how far off the site is, as a share of the prior's SDs."""


def phantom_of(table: PopulationTable, row: int, rng: np.random.Generator) -> PhantomMap:
    """A map of the table as a phantom's, with draws of its posterior."""
    middle = [table.log_amplitude[row], table.log_width[row], table.half_log_ratio[row]]
    a, p, q = rng.multivariate_normal(middle, table.covariance[row], DRAWS, method="eigh").T
    assert table.profile is not None
    shape = ShapeDraws(a, p, q, np.zeros(DRAWS), profile=tuple(table.profile[row].tolist()))
    own = {name: float(table.unknowns[name][row]) for name in STATED}
    known = {name: value if name == "seat" else float(np.exp(value)) for name, value in own.items()}
    return PhantomMap(str(table.body[row]), float(table.d_mm[row]), shape, known)


def patients_of(calibration: BodyCalibration, table: PopulationTable) -> FloatArray:
    """(3, exams) errors of ln d by one exam each, the variances stated, and the widths over the table's middle."""
    found = errors(calibration, table)
    return np.stack([*found, table.log_width - calibration.centre.log_width])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each kind of site."""
    words = parser(__name__, __doc__)
    words.add_argument("--sites", type=int, default=200)
    given = words.parse_args(arguments)
    table, rng = population("gain"), np.random.default_rng(SEED)
    bodies = np.unique(table.body)
    taught = np.isin(table.body, np.random.default_rng(1).permutation(bodies)[: int(LEARNED * len(bodies))])
    calibration = learn_population(rows_of(table, taught), recipe=shipped("solid").recipe)
    rest = rows_of(table, ~taught)
    rest = rows_of(rest, np.isin(np.arange(len(rest)), np.unique(rest.body, return_index=True)[1]))
    exams = patients_of(calibration, rest)
    hard = np.flatnonzero(np.exp(rest.unknowns["stiffness_ratio"]) >= LEAST_HARD_RATIO)
    for count, stated, off in SITES:
        found = []
        for _ in range(given.sites):
            shift, slope = off * rng.normal(0.0, SitePrior().sd)
            chosen = rng.choice(hard, count, replace=False)
            others = rng.choice(np.setdiff1d(np.arange(len(rest)), chosen), PATIENTS, replace=False)
            maps = []
            for row in chosen:
                one = phantom_of(rest, row, rng)
                d_mm = one.d_mm * float(np.exp(shift + slope * exams[2, row]))
                maps.append(PhantomMap(one.phantom, d_mm, one.shape, one.known if stated else {}))
            site = correct_calibration(calibration, maps, base="held-out").site
            assert site is not None
            error, variance, width = exams[:, others]
            before = error - shift - slope * width
            log_width = width + site.centre
            found.append([before, before + site.log_shift(log_width), np.sqrt(variance + site.variance(log_width))])
        before, after, sd = np.concatenate(found, axis=1)
        covered = np.abs(after) < NORMAL_95 * sd
        print(
            f"{count:2} phantoms, {'stated' if stated else 'nothing stated'}, site off by {off:g} SD: mean error "
            f"{100 * np.abs(np.expm1(after)).mean():.1f} % ({100 * np.abs(np.expm1(before)).mean():.1f} without a "
            f"correction), {100 * covered.mean():.1f} % of 95 % intervals cover",
            flush=True,
        )
