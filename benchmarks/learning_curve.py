"""Errors of a size calibration on bodies that it was not learned from, by the number of bodies and by the form.

    python -m benchmarks.learning_curve POPULATION.csv

POPULATION.csv is a table of `population`. From it, N bodies are drawn at random, each form learns from them, and the
others are sized by the mean of their exams. Printed: mean absolute error and bias, share of 95 % intervals that hold,
SD of standardised errors, median half width; then the same of the last form by classes of lumps. With `--known
stiffness_ratio` sizes are given the true value of each held-out body, as `estimate --known` would be.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from tactile_bayes.files.tables import read_table
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.normal import skewed_score
from tactile_bayes.pipeline.size_calibration import FORMS, population_learner, rows_of_one_way
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.hidden import LOGGED
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.mass_calibration import MassCalibration
from tactile_bayes.size.supposed import known_body
from tactile_bayes.studies.population import UNKNOWNS, population_table

_STEP = 1e-3
_NORMAL_95 = 1.959964


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", type=Path)
    parser.add_argument("--normalise", default="gain")
    parser.add_argument("--bodies", type=int, nargs="+", default=[250, 500, 1000, 2000])
    parser.add_argument("--forms", nargs="+", choices=FORMS, default=["log-quadratic", "gaussian-process"])
    parser.add_argument("--without-places", action="store_true", help="learn without the figures by place")
    parser.add_argument("--known", nargs="+", choices=UNKNOWNS, default=[], help="properties told of each body")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    way, columns = rows_of_one_way(read_table(given.table, "population.table.json"), given.normalise)
    table = population_table(columns)
    if given.without_places:
        table = replace(table, by_place=None)
    bodies, ways = np.unique(table.body), [(), tuple(given.known)] if given.known else [()]
    for number in given.bodies:
        if number > len(bodies) - 20:
            print(f"{number:5d}: the table has {len(bodies)} bodies")
            continue
        for form in given.forms:
            learn = partial(population_learner(form), recipe=Recipe(way, "free", 20.0, noise="field"))
            held = [_held_out(table, learn, ways, number, given.seed + i) for i in range(given.repeats)]
            found = [Sized.joined(one) for one in zip(*held, strict=True)]
            for known, sized in zip(ways, found, strict=True):
                print(f"{number:5d} {form:17s} {sized.figures()}{_words(known)}", flush=True)
    for known, sized in zip(ways, found, strict=True):
        print(f"by classes{_words(known)}")
        _by_class(table, sized)


@dataclass(frozen=True, slots=True)
class Sized:
    """Bodies that took no part: (b,) ln of sized over true size, stated variance and skewness, and their numbers."""

    error: FloatArray
    variance: FloatArray
    skewness: FloatArray
    body: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Sized]) -> Sized:
        """Those of several draws of bodies."""
        return cls(*(np.concatenate([getattr(one, name) for one in parts]) for name in cls.__match_args__))

    def rows(self, members: FloatArray) -> Sized:
        """Some of them."""
        return Sized(*(getattr(self, name)[members] for name in Sized.__match_args__))

    def figures(self) -> str:
        """Errors and intervals in words."""
        sd = np.sqrt(self.variance)
        low, high = (sd * skewed_score(np.full(len(sd), z), self.skewness) for z in (-_NORMAL_95, _NORMAL_95))
        held = (low < -self.error) & (-self.error < high)
        off = np.expm1(self.error)
        return (
            f"{len(sd):5d} bodies  MAE {100 * np.mean(np.abs(off)):5.2f} %  bias {100 * np.mean(off):+5.2f} %  "
            f"held {100 * np.mean(held):5.1f} %  SD of standardised errors {(self.error / sd).std():.2f}  "
            f"median half width {50 * np.median(np.exp(high) - np.exp(low)):.1f} %"
        )


def _words(known: Sequence[str]) -> str:
    return f"  known: {', '.join(known)}" if known else ""


def _held_out(
    table: PopulationTable,
    learn: Callable[..., BodyCalibration],
    ways: Sequence[Sequence[str]],
    number: int,
    seed: int,
) -> list[Sized]:
    """The bodies that took no part, sized with each set of known properties."""
    bodies = np.unique(table.body)
    taught = np.random.default_rng(seed).permutation(bodies)[:number]
    calibration = learn(table.rows(np.isin(table.body, taught)))
    rest = np.setdiff1d(bodies, taught)
    exams = [table.rows(table.body == one) for one in rest]
    sized = (np.array([size_error(calibration, one, known=known) for one in exams]) for known in ways)
    return [Sized(*found.T, rest) for found in sized]


def size_error(
    calibration: BodyCalibration, exams: PopulationTable, *, known: Sequence[str] = ()
) -> tuple[float, float, float]:
    """Log error of one body by the mean of its exams, and the variance and skewness that the calibration states.

    Parameters
    ----------
    known
        Properties of which the true value is told.
    """
    at_depth = calibration.at_fat(_known(exams.profile, len(exams)))
    fitted = MassCalibration.of(at_depth, _known(exams.by_place, len(exams)))
    at, a, p = fitted.mass, exams.log_amplitude, exams.log_width
    by_exam = zip(fitted.maps, a, p, exams.covariance[:, :2, :2], strict=True)
    size, noise, terms = (np.array(one) for one in zip(*(_by_exam(*one) for one in by_exam), strict=True))
    exam = noise.mean() + np.exp(2 * at.mean[-1])
    middle = a.mean(keepdims=True), p.mean(keepdims=True)
    body, _, error = at.body_and_error(terms.mean(axis=0, keepdims=True), *middle, np.zeros(1))
    told = {name: float(exams.unknowns[name][0]) for name in known}
    told = {name: float(np.exp(value)) if name in LOGGED else value for name, value in told.items()}
    own_sd = at.own_sd(body)
    left = known_body(at, told, *middle, own_sd)
    variance = left.variance[0] + at.other_sd**2 + error[0] + exam / len(exams)
    skewness = left.skewness[0] * (left.variance[0] / variance) ** 1.5
    return float(size.mean() + left.expected[0] - np.log(exams.d_mm[0])), float(variance), float(skewness)


def _by_exam(
    at: BodyCalibration, log_a: FloatArray, p: FloatArray, covariance: FloatArray
) -> tuple[float, float, FloatArray]:
    """ln d by one exam, its variance by the map, and its terms."""
    by_a = (at.log_size(log_a + _STEP, p) - at.log_size(log_a - _STEP, p)) / (2 * _STEP)
    slope = np.array([by_a, at.width_slope(log_a, p)])
    return float(at.log_size(log_a, p)), at.map_factor * float(slope @ covariance @ slope), at.terms(log_a, p)


def _known(figures: FloatArray | None, number: int) -> Sequence[tuple[float, ...] | None]:
    """Figures of each exam; None where it has none."""
    if figures is None:
        return [None] * number
    return [tuple(one) if np.isfinite(one).all() else None for one in figures]


def _by_class(table: PopulationTable, sized: Sized) -> None:
    """The last form's figures for soft, centred, deep and faint lumps, and for clear ones."""
    first = {one: int(np.flatnonzero(table.body == one)[0]) for one in np.unique(table.body)}
    row = np.array([first[one] for one in sized.body])
    stiffness, seat = np.exp(table.unknowns["stiffness_ratio"][row]), table.unknowns["seat"][row]
    ratio = np.exp(table.unknowns["depth_mm"][row]) / table.d_mm[row]
    amplitude = np.exp(table.log_amplitude[row])
    classes = {
        "soft (E2/E1 below 15)": stiffness < 15,
        "hard (50 and more)": stiffness >= 50,
        "softest (below 9)": stiffness < 9,
        "centred (seat 0)": seat == 0,
        "soft and centred": (stiffness < 15) & (seat == 0),
        "out of the gland (seat 0.8 and more)": seat >= 0.8,
        "deep (h/d 1.4 and more)": ratio >= 1.4,
        "shallow (h/d below 0.8)": ratio < 0.8,
        "faint (amplitude below 0.1)": amplitude < 0.1,
        "clear (amplitude 0.3 and more)": amplitude >= 0.3,
    }
    for name, members in classes.items():
        if members.sum() > 1:
            print(f"{name:37s} {sized.rows(members).figures()}")


if __name__ == "__main__":
    main()
