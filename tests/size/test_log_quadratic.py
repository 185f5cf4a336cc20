"""The log-quadratic calibration against tables made from known coefficients, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.size_quadratic_json import write_log_quadratic
from tactile_bayes.head_shape import DEFAULT_HEAD
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.learn.log_quadratic import learn_log_quadratic
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable, held, left_out_errors
from tactile_bayes.size.log_quadratic import LogQuadratic

TRUE = np.array([2.3, 0.28, 1.0, 0.0, -0.03, 0.18])
BODY_SD, EXAM_SD, MAP_SD, SEAT_SLOPE = 0.05, 0.02, 0.03, -0.2
RECIPE = Recipe("mean", "free", 20.0, False, "field")


def population(
    bodies: int = 300, *, exams: int = 2, seed: int = 1, exam_sd: float = EXAM_SD, seat_slope: float = SEAT_SLOPE
) -> PopulationTable:
    """ln d as a quadratic of what the map shows, plus a seat, a body's own error, an exam's, and the map's noise."""
    rng = np.random.default_rng(seed)
    body = np.repeat(np.arange(bodies), exams)
    n = len(body)
    true_u = rng.normal(0, 1, bodies)[body] + rng.normal(0, 0.02, n)
    true_v = rng.normal(0, 0.4, bodies)[body]
    seat = rng.uniform(0, 1.2, bodies)
    own = rng.normal(0, BODY_SD, bodies) + seat_slope * (seat - 0.6)
    x = np.stack([np.ones(n), true_u, true_v, true_u**2, true_u * true_v, true_v**2], axis=1)
    # one diameter a body: what the exams of one body differ by is an error of the map
    log_d = np.array([(x @ TRUE)[body == b].mean() for b in range(bodies)]) + own
    noise_p = rng.normal(0, np.hypot(MAP_SD, exam_sd), n)
    covariance = np.tile(np.diag([1e-6, MAP_SD**2, 1e-4]), (n, 1, 1))
    q = 0.04 - 0.02 * true_u + rng.normal(0, 0.02, bodies)[body] + rng.normal(0, 0.015, n)
    table = PopulationTable(
        body, np.exp(log_d[body]), true_u - 0.8, true_v + noise_p + 1.4, q, covariance, {"seat": seat[body]}
    )
    return replace(table, unknowns={**table.unknowns, "fat_kpa": rng.normal(size=bodies)[body]})


@pytest.fixture(scope="module")
def learned() -> LogQuadratic:
    return learn_log_quadratic(population(), recipe=RECIPE)


def test_known_coefficients_are_found_within_their_own_errors(learned):
    a0, p0 = learned.centre
    u, v = np.meshgrid(np.linspace(-1.5, 1.5, 7), np.linspace(-0.5, 0.5, 5))
    x = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    found = learned.log_size(u - 0.8, v + 1.4)
    terms = learned.terms(u - 0.8, v + 1.4)
    sd = np.sqrt(np.einsum("...i,ij,...j->...", terms, learned.covariance[:6, :6], terms))
    # the noise in v flattens its slope a little: 0.036^2 / 2 / 0.4^2 is below 1 %
    assert np.abs((found - x @ TRUE) / np.hypot(sd, 0.005)).max() < 4
    assert a0 == pytest.approx(-0.8, abs=0.2)
    assert p0 == pytest.approx(1.4, abs=0.1)


def test_exams_of_one_body_do_not_flatten_the_slope():
    """Within a body d is one while the map varies: a model that took that for a slope found 0.92 instead of 1."""
    many = learn_log_quadratic(population(exams=4), recipe=RECIPE)
    assert many.mean[2] == pytest.approx(1.0, abs=0.04)


def test_errors_of_bodies_left_out_are_those_of_refitting():
    table = population(bodies=30, exams=1)
    u, v = table.log_amplitude + 0.8, table.log_width - 1.4
    x = np.stack([np.ones(30), u, v, u * u, u * v, v * v], axis=1)
    y = np.log(table.d_mm)
    by_hand = [x[i] @ np.linalg.lstsq(np.delete(x, i, 0), np.delete(y, i), rcond=None)[0] - y[i] for i in range(30)]
    np.testing.assert_allclose(left_out_errors(x, y), by_hand, atol=1e-10)


def test_intervals_of_bodies_left_out_hold_as_often_as_they_say():
    """Spreads that are right hold nine in ten; half of them hold 59 % (a normal's 0.822 SD each way)."""
    many = learn_log_quadratic(population(bodies=400), recipe=RECIPE)
    data = BodyRegression.of(population(bodies=400), many.terms)
    error = left_out_errors(data.mean_terms, data.mean_log_d)
    assert many.fit["left_out_held_percent"] == pytest.approx(90, abs=4)
    halved = many.mean + np.array([0.0] * 6 + [-np.log(2), 0.0, -np.log(2)])
    assert 100 * held(data, halved, error) == pytest.approx(59, abs=7)


def test_spread_between_bodies_and_between_exams_is_told_apart(learned):
    total = np.hypot(BODY_SD, abs(SEAT_SLOPE) * 1.2 / np.sqrt(12))
    assert np.exp(learned.mean[6]) == pytest.approx(total, rel=0.15)
    assert np.exp(learned.mean[8]) == pytest.approx(EXAM_SD, rel=0.6)


def test_exams_that_differ_more_are_seen_to():
    wide = learn_log_quadratic(population(exam_sd=0.08), recipe=RECIPE)
    assert np.exp(wide.mean[8]) == pytest.approx(0.08, rel=0.25)


def test_what_decides_is_named_and_what_does_not_is_not(learned):
    true_share = 1 / (1 + (BODY_SD / (SEAT_SLOPE * 1.2 / np.sqrt(12))) ** 2)
    assert learned.unknowns["seat"] == pytest.approx(true_share, abs=0.1)
    assert learned.unknowns["fat_kpa"] < 0.05
    without = learn_log_quadratic(population(seat_slope=0.0), recipe=RECIPE)
    assert without.unknowns["seat"] < 0.05


def test_a_known_seat_moves_the_size_and_narrows_it(learned):
    assert learned.hidden is not None
    terms = learned.terms(np.array(-0.8), np.array(1.4))
    body_sd = min(np.exp(learned.mean[6] + learned.mean[7] * terms[1]), learned.hidden.most_sd)
    low, high = (body_sd * float(learned.hidden.expected_body({"seat": s}, terms)) for s in (0.0, 1.2))
    assert low - high == pytest.approx(-SEAT_SLOPE * 1.2, rel=0.15)
    assert learned.hidden.share("seat", "fat_kpa") >= learned.hidden.share("seat") - 1e-12


def with_unknown(name: str, values: np.ndarray, effect: np.ndarray) -> PopulationTable:
    """Bodies of which one more property is known, with what it does to ln d."""
    table = population(bodies=len(values), seat_slope=0.0)
    one = table.body.astype(int)
    return replace(table, d_mm=table.d_mm * np.exp(effect[one]), unknowns={name: values[one]})


def test_soft_lumps_have_no_bias_where_their_stiffness_is_known():
    """What is 50 times as stiff as fat and what is 100 times are alike; 8 and 16 times are not."""
    ratio = np.exp(np.random.default_rng(4).uniform(np.log(8), np.log(100), 600))
    table = with_unknown("stiffness_ratio", np.log(ratio), 2.0 / ratio)
    learned = learn_log_quadratic(table, recipe=RECIPE)
    assert learned.hidden is not None
    a, p = table.log_amplitude, table.log_width
    without = learned.log_size(a, p) - np.log(table.d_mm)
    features, body_sd = learned.features(a, p), np.exp(learned.mean[6] + learned.mean[7] * learned.terms(a, p)[:, 1])
    told = [learned.hidden.expected_body({"stiffness_ratio": np.exp(v)}, x)
            for v, x in zip(table.unknowns["stiffness_ratio"], features, strict=True)]  # fmt: skip
    known = without + np.minimum(body_sd, learned.hidden.most_sd) * np.array(told)
    for low, high in ((8, 11), (11, 30), (50, 101)):
        members = (ratio >= low)[table.body] & (ratio < high)[table.body]
        assert abs(known[members].mean()) < 0.02
    assert without[(ratio < 11)[table.body]].mean() < -0.08  # the control: not told, they come out small


def test_where_bodies_differ_more_does_not_decide_what_a_property_tells():
    """B is 0.8 SD of B times a property's own scale, everywhere; faint lumps' SD is ten times the strong ones'."""
    rng = np.random.default_rng(6)
    table = population(bodies=600, seat_slope=0.0)
    one = table.body.astype(int)
    u = (table.log_amplitude + 0.8)[::2]
    seat, rest = rng.normal(size=(2, 600))
    effect = 0.4 * np.exp(-0.8 * u) * (0.8 * seat + 0.6 * rest)
    wide = replace(table, d_mm=table.d_mm * np.exp(effect[one]), unknowns={"seat": seat[one]})
    found = learn_log_quadratic(wide, recipe=RECIPE)
    assert found.unknowns["seat"] == pytest.approx(0.8**2, abs=0.1)  # 0.3 where all bodies count alike


def test_a_balls_oval_map_is_learned_with_its_spread(learned):
    assert learned.round_excess(np.array(-0.8), np.array(1.4)) == pytest.approx(0.04, abs=0.005)
    assert learned.round_lumps.spread.variance(np.array(1e-4)) == pytest.approx(0.02**2 + 0.015**2, rel=0.2)


@pytest.mark.parametrize(
    ("amplitude", "sigma", "words"),
    [(0.45, 4.0, None), (50.0, 4.0, "amplitude"), (0.45, 60.0, "sigma"), (0.02, 1.3, "unlike")],
)
def test_a_map_unlike_the_table_is_told(learned, amplitude, sigma, words):
    low = {"amplitude": (1e-3, 20.0), "sigma_mm": (1.0, 20.0), "d_mm": (3.0, 40.0)}
    found = replace(learned, domain=low).outside(amplitude, sigma)
    assert (not found) if words is None else words in " ".join(found)


def test_a_file_holds_what_was_learned(learned, tmp_path: Path):
    path = tmp_path / "size.json"
    write_log_quadratic(path, learned, provenance=Provenance("test", {}, {}))
    back = read_size_calibration(path)
    assert isinstance(back, LogQuadratic)
    np.testing.assert_allclose(back.mean, learned.mean, rtol=1e-8)
    assert back.unknowns == pytest.approx(learned.unknowns, rel=1e-6)
    # a file without a head is of a version that knew the paper's only
    assert back.recipe == replace(learned.recipe, head=DEFAULT_HEAD)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mean": [0.0] * 8}, "mean"),
        ({"covariance": [[-1.0 if i == j else 0.0 for j in range(9)] for i in range(9)]}, "negative eigenvalue"),
        ({"most_leverage": 0}, "most_leverage"),
        ({"parameters": ["1"]}, "parameters"),
        ({"surplus": 1}, "surplus"),
    ],
)
def test_a_spoilt_file_is_refused_by_the_field(learned, tmp_path: Path, change, words):
    path = tmp_path / "size.json"
    write_log_quadratic(path, learned, provenance=Provenance("test", {}, {}))
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(BadDataError, match=words):
        read_size_calibration(path)


def test_tables_that_determine_nothing_are_refused():
    few = population(bodies=12)
    with pytest.raises(BadDataError, match="12 bodies"):
        learn_log_quadratic(few, recipe=RECIPE)
    table = population(bodies=40)
    with pytest.raises(BadDataError, match="one d_mm"):
        learn_log_quadratic(replace(table, d_mm=np.full(len(table), 15.0)), recipe=RECIPE)
    spoilt = table.log_width.copy()
    spoilt[3] = np.nan
    with pytest.raises(BadDataError, match="not finite"):
        learn_log_quadratic(replace(table, log_width=spoilt), recipe=RECIPE)
