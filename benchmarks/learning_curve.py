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
from functools import partial
from pathlib import Path

import numpy as np

from tactile_bayes.files.tables import read_table
from tactile_bayes.geometry import FloatArray
from tactile_bayes.pipeline.size_calibration import FORMS, rows_of_one_way
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.learn.left_out import Sized, sized
from tactile_bayes.size.learn.population import learn_population
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.studies.population import UNKNOWNS, population_table

_NORMAL_95 = 1.959964


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", type=Path)
    parser.add_argument("--normalise", default="gain")
    parser.add_argument("--bodies", type=int, nargs="+", default=[250, 500, 1000, 2000])
    parser.add_argument("--forms", nargs="+", choices=FORMS, default=list(FORMS))
    parser.add_argument("--known", nargs="+", choices=UNKNOWNS, default=[], help="properties told of each body")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    way, columns = rows_of_one_way(read_table(given.table, "population.table.json"), given.normalise)
    table = population_table(columns)
    bodies, ways = np.unique(table.body), [(), tuple(given.known)] if given.known else [()]
    for number in given.bodies:
        if number > len(bodies) - 20:
            print(f"{number:5d}: the table has {len(bodies)} bodies")
            continue
        for form in given.forms:
            recipe = Recipe(way, "free", 20.0, noise="field")
            learn = partial(learn_population, recipe=recipe, residual=form == "eq6-residual")
            held = [_held_out(table, learn, ways, number, given.seed + i) for i in range(given.repeats)]
            numbers = np.concatenate([one for one, _ in held])
            found = [_joined(one) for one in zip(*(sizes for _, sizes in held), strict=True)]
            for known, one in zip(ways, found, strict=True):
                print(f"{number:5d} {form:12s} {figures(one)}{_words(known)}", flush=True)
    for known, one in zip(ways, found, strict=True):
        print(f"by classes{_words(known)}")
        _by_class(table, one, numbers)


def figures(found: Sized) -> str:
    """Errors and intervals in words."""
    sd, off = np.sqrt(found.variance), np.expm1(found.error)
    held = np.abs(found.error) < _NORMAL_95 * sd
    return (
        f"{len(sd):5d} bodies  MAE {100 * np.mean(np.abs(off)):5.2f} %  bias {100 * np.mean(off):+5.2f} %  "
        f"held {100 * np.mean(held):5.1f} %  SD of standardised errors {(found.error / sd).std():.2f}  "
        f"median half width {100 * np.median(np.sinh(_NORMAL_95 * sd)):.1f} %"
    )


def _words(known: Sequence[str]) -> str:
    return f"  known: {', '.join(known)}" if known else ""


def _held_out(
    table: PopulationTable,
    learn: Callable[..., BodyCalibration],
    ways: Sequence[Sequence[str]],
    number: int,
    seed: int,
) -> tuple[FloatArray, list[Sized]]:
    """The bodies that took no part, and their sizes with each set of known properties."""
    bodies = np.unique(table.body)
    taught = np.random.default_rng(seed).permutation(bodies)[:number]
    calibration = learn(table.rows(np.isin(table.body, taught)))
    rest = table.rows(~np.isin(table.body, taught))
    return np.unique(rest.body), [sized(calibration, rest, known=known) for known in ways]


def _joined(parts: Sequence[Sized]) -> Sized:
    """Those of several draws of bodies."""
    return Sized(*(np.concatenate([getattr(one, name) for one in parts]) for name in ("error", "variance")))


def _by_class(table: PopulationTable, found: Sized, bodies: FloatArray) -> None:
    """The last form's figures for soft, centred, deep and faint lumps, and for clear ones."""
    first = {one: int(np.flatnonzero(table.body == one)[0]) for one in np.unique(table.body)}
    row = np.array([first[one] for one in bodies])
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
            print(f"{name:37s} {figures(Sized(found.error[members], found.variance[members]))}")


if __name__ == "__main__":
    main()
