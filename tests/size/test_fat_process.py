"""The Gaussian process over a population, against exact regression, tables made from a known law, and its own file."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.size_quadratic_json import write_log_quadratic
from tactile_bayes.presets import BY_PLACE
from tactile_bayes.size.body_calibration import UNLIKE_SD
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.fat_process import FatProcess, Kernel, ProcessAtProfile, squared_exponential
from tactile_bayes.size.learn.fat_depth import FatTable, learn_fat_cubic
from tactile_bayes.size.learn.fat_process import learn_fat_process, place_table
from tactile_bayes.size.learn.log_quadratic import learn_log_quadratic
from tactile_bayes.size.learn.process_fit import ProcessRows, drawn_points, given
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.log_quadratic import LogQuadratic

RECIPE = Recipe("gain", "free", 20.0, False, "field")
EXAM_SD = 0.01


def law(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """ln d of a body, with a ripple that no cubic follows."""
    return 2.3 + 0.3 * u + v - 0.2 * w + 0.12 * np.sin(3.5 * u) * np.cos(1.5 * w)


def body_sd(u: np.ndarray) -> np.ndarray:
    """Between bodies: ten times as much for the faintest as for the strongest."""
    return np.asarray(0.03 * np.exp(-0.5 * u))


def profile_of(w: np.ndarray) -> np.ndarray:
    """(n, 3) profiles that tell w by their first figure."""
    return np.column_stack([0.1 * w, np.random.default_rng(9).normal(0, 0.05, (len(w), 2))])


def table(bodies: int = 300, *, seed: int = 1) -> PopulationTable:
    rng = np.random.default_rng(seed)
    body = np.repeat(np.arange(bodies), 2)
    u, v, w = rng.uniform(-2, 2, bodies), rng.normal(0, 0.35, bodies), rng.normal(0, 0.45, bodies)
    log_d = law(u, v, w) + body_sd(u) * rng.normal(size=bodies)
    wobble = rng.normal(0, EXAM_SD, len(body))
    covariance = np.tile(np.diag([1e-6, 1e-6, 1e-4]), (len(body), 1, 1))
    q = 0.04 - 0.02 * u[body] + rng.normal(0, 0.01, len(body))
    unknowns = {"seat": rng.uniform(0, 1.2, bodies)[body]}
    log_a, p = u[body] - 1.0, v[body] + wobble + 1.4
    return PopulationTable(
        body, np.exp(log_d[body]), log_a, p, q, covariance, unknowns, profile_of(w[body]), 2.6 + w[body]
    )


@pytest.fixture(scope="module")
def learned() -> LogQuadratic:
    """Of a table whose bodies are all that there are."""
    return learn_log_quadratic(table(), recipe=RECIPE, learn_fat=partial(learn_fat_process, other_sd=0.0))


def rows_of(bodies: int) -> ProcessRows:
    found = FatTable.of(table(bodies))
    assert found is not None
    return ProcessRows.of(replace(found, centre=(-1.0, 1.4, 2.6)))


def test_with_a_point_for_each_body_it_is_exact_regression() -> None:
    """Against Gaussian-process regression by its textbook formula, the linear part as a kernel of its own."""
    rows, theta = rows_of(80), np.zeros(6)
    theta = np.concatenate([np.log([1.5, 0.8, 2.0, 2.0, 2.0, 0.3]), [np.log(0.05)], np.zeros(9)])
    one_each = replace(rows, x=rows.mean(rows.x)[rows.data.group])
    points = one_each.mean(one_each.x)
    fitted = given(one_each, points, theta, exam_sd=EXAM_SD)
    linear, noise = fitted.terms[:, :4], np.full(80, 0.05**2 + EXAM_SD**2 / 2)
    kernel = 0.3**2 * squared_exponential(points, points, np.exp(theta[:5])) + 100.0 * linear @ linear.T
    weights = np.linalg.solve(kernel + np.diag(noise), rows.data.mean_log_d)
    np.testing.assert_allclose(fitted.terms @ fitted.mean, kernel @ weights, atol=2e-5)
    # bodies left out, by the textbook formula too (Rasmussen & Williams 2006, eq. 5.12)
    inverse = np.linalg.inv(kernel + np.diag(noise))
    error, variance = fitted.left_out(rows.data.mean_log_d)
    np.testing.assert_allclose(error, -weights / np.diag(inverse), atol=2e-4)
    np.testing.assert_allclose(variance, 1.0 / np.diag(inverse), rtol=1e-2)
    density = -0.5 * np.sum(np.log(variance) + error**2 / variance)
    assert fitted.left_out_density(rows.data.mean_log_d) == pytest.approx(density)
    # the control: with other lengths it is another regression
    other = given(one_each, points, theta + np.r_[1.0, np.zeros(len(theta) - 1)], exam_sd=EXAM_SD)
    assert np.abs(other.terms @ other.mean - kernel @ weights).max() > 1e-3


def test_bodies_left_out_are_predicted_as_if_the_fit_had_not_seen_them() -> None:
    rows = rows_of(80)
    theta = np.concatenate([np.log([1.5, 0.8, 2.0, 2.0, 2.0, 0.3]), [np.log(0.05)], np.zeros(9)])
    points = rows.mean(rows.x)[::3]
    fitted = given(rows, points, theta, exam_sd=EXAM_SD)
    error, variance = fitted.left_out(rows.data.mean_log_d)
    for body in (0, 17):
        weight = np.where(np.arange(80) == body, 1e-12, 1.0)
        scaled = fitted.terms * np.sqrt(weight / fitted.variance)[:, None]
        prior = np.diag(np.r_[np.full(4, 1e-2), np.ones(len(points))])
        covariance = np.linalg.inv(scaled.T @ scaled + prior)
        mean = covariance @ (scaled.T @ (rows.data.mean_log_d * np.sqrt(weight / fitted.variance)))
        assert error[body] == pytest.approx(fitted.terms[body] @ mean - rows.data.mean_log_d[body], rel=1e-6)
        left = fitted.variance[body] + fitted.terms[body] @ covariance @ fitted.terms[body]
        assert variance[body] == pytest.approx(left, rel=1e-6)


def test_points_are_bodies_and_lie_as_they_do() -> None:
    x = np.random.default_rng(3).normal(size=(2000, 5))
    points = drawn_points(x, 400)
    assert len(np.unique(points, axis=0)) == 400
    assert {tuple(one) for one in points} <= {tuple(one) for one in x}
    np.testing.assert_allclose(points.std(axis=0), x.std(axis=0), rtol=0.12)
    # the control: a kernel's pivots lie at the ends first
    ends = x[np.argsort(np.abs(x).sum(axis=1))[-400:]]
    assert (ends.std(axis=0) > 1.3 * x.std(axis=0)).all()


def test_it_follows_a_law_that_no_cubic_does(learned) -> None:
    u, v = np.meshgrid(np.linspace(-1.8, 1.8, 13), [-0.3, 0.0, 0.3])
    by_cubic = replace(learned, with_fat=learn_fat_cubic(table()))
    for w in (-0.5, 0.0, 0.5):
        at = learned.at_fat([tuple(profile_of(np.array([w]))[0])])
        assert isinstance(at, ProcessAtProfile)
        error = at.log_size(u - 1.0, v + 1.4) - law(u, v, np.full_like(u, w))
        assert np.sqrt(np.mean(error**2)) < 0.035
        cubic = by_cubic.at_fat([tuple(profile_of(np.array([w]))[0])])
        error = cubic.log_size(u - 1.0, v + 1.4) - law(u, v, np.full_like(u, w))
        assert np.sqrt(np.mean(error**2)) > 0.05


def test_the_spread_between_bodies_depends_on_the_place(learned) -> None:
    at = learned.at_fat([tuple(profile_of(np.array([0.0]))[0])])
    u = np.array([-1.5, 0.0, 1.5])
    terms = at.terms(u - 1.0, np.full(3, 1.4))
    found, _, error = at.body_and_error(terms, u - 1.0, np.full(3, 1.4), np.zeros(3))
    np.testing.assert_allclose(found, body_sd(u), rtol=0.3)
    assert (error > 0).all()
    assert found[0] > 2.5 * found[2]


def test_its_intervals_hold_on_bodies_never_seen(learned) -> None:
    """The control: with half the spreads they do not."""
    fresh = table(400, seed=77)
    first = fresh.rows(np.arange(len(fresh)) % 2 == 0)
    inside, narrow = [], []
    for i in range(len(first)):
        at = learned.at_fat([tuple(first.profile[i])])
        a, p = first.log_amplitude[i : i + 1], first.log_width[i : i + 1]
        body, _, error = at.body_and_error(at.terms(a, p), a, p, np.zeros(1))
        sd = float(np.sqrt(body[0] ** 2 + error[0] + np.exp(2 * at.mean[-1])))
        off = abs(float(at.log_size(a, p)[0]) - np.log(first.d_mm[i]))
        inside.append(off < 1.96 * sd)
        narrow.append(off < 0.98 * sd)
    assert 0.92 <= np.mean(inside) <= 0.985
    assert np.mean(narrow) < 0.85


def test_bodies_of_another_kind_widen_the_spread(learned) -> None:
    a, p, one = np.array([0.5]), np.array([1.4]), [tuple(profile_of(np.array([0.0]))[0])]
    wider = replace(learned, with_fat=replace(learned.with_fat, other_sd=0.05)).at_fat(one)
    spreads = [at.body_and_error(at.terms(a, p), a, p, np.zeros(1))[0][0] for at in (learned.at_fat(one), wider)]
    assert spreads[1] == pytest.approx(np.hypot(spreads[0], 0.05))


def test_a_profile_unlike_the_tables_leaves_room_for_another_kind_of_body(learned) -> None:
    """And a map without a profile does not: it says nothing of the body."""
    unlike, without = learned.at_fat([(3.0, 0.0, 0.0)]), learned.at_fat([None])
    assert unlike.fat_mm is without.fat_mm is None
    assert (unlike.other_sd, without.other_sd) == (UNLIKE_SD, 0.0)
    a, p = np.array([0.5]), np.array([1.4])
    wide, narrow = (at.body_and_error(at.terms(a, p), a, p, np.zeros(1))[0][0] for at in (unlike, without))
    assert wide == pytest.approx(np.hypot(narrow, UNLIKE_SD))
    assert "allows 10 % (SD) more" in " ".join(unlike.omissions())
    assert "allows" not in " ".join(without.omissions())


def test_a_map_unlike_the_tables_at_its_depth_leaves_room_for_another_kind_of_body(learned) -> None:
    at = learned.at_fat([tuple(profile_of(np.array([0.0]))[0])])
    far, near = at.fitting(np.exp(8.0), np.exp(4.0)), at.fitting(np.exp(-1.0), np.exp(1.4))
    assert (far.fat_mm, far.other_sd) == (None, UNLIKE_SD)
    assert near is at


def test_slopes_and_terms_are_those_of_the_size(learned) -> None:
    at, h = learned.at_fat([tuple(profile_of(np.array([0.2]))[0])]), 1e-5
    a, p = np.random.default_rng(5).normal(size=(2, 6)) * [[0.8], [0.3]] + [[-1.0], [1.4]]
    slope = (at.log_size(a, p + h) - at.log_size(a, p - h)) / (2 * h)
    np.testing.assert_allclose(at.width_slope(a, p), slope, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(at.terms(a, p) @ at.mean[: at.coefficients], at.log_size(a, p), atol=1e-9)
    assert np.isnan(at.log_size(np.array([np.nan]), np.array([1.4]))).all()


def test_a_draw_far_from_all_bodies_has_the_linear_size(learned) -> None:
    at = learned.at_fat([tuple(profile_of(np.array([0.0]))[0])])
    far = np.array([-400.0])
    linear = at.mean[0] + at.mean[1] * (far - at.centre[0]) + at.mean[2] * (1.4 - at.centre[1])
    np.testing.assert_allclose(at.log_size(far, np.array([1.4])), linear)


def test_maps_of_a_mass_share_their_mean_profile(learned) -> None:
    one, other = (tuple(profile_of(np.array([w]))[0]) for w in (-0.1, 0.1))
    between = learned.at_fat([one, other, None])
    assert isinstance(between, ProcessAtProfile)
    alone = learned.at_fat([tuple(np.mean([one, other], axis=0))])
    np.testing.assert_allclose(between.profile, alone.profile, atol=1e-12)


def seats(bodies: int, *, seed: int) -> np.ndarray:
    """What neither bump nor profile tells of the bodies of a table."""
    return np.random.default_rng(100 + seed).normal(size=bodies)


def table_by_place(bodies: int = 300, *, seed: int = 1, told: bool = True) -> PopulationTable:
    """Bodies whose size also depends on a seat that the figures by place tell; not `told`, they tell another body's."""
    one = table(bodies, seed=seed)
    seat = seats(bodies, seed=seed)
    noise = np.random.default_rng(200 + seed).normal(size=(len(one), len(BY_PLACE)))
    figures = 0.1 * noise + [1.0, -0.4, -0.2, 0.2, -0.6, -0.3]
    figures[:, 1] += (seat if told else np.roll(seat, 1))[one.body.astype(int)]
    seat = seat[one.body.astype(int)]
    return replace(one, d_mm=one.d_mm * np.exp(0.1 * seat), by_place=figures, unknowns={"seat": seat})


def spread_of_errors(calibration: LogQuadratic, maps: PopulationTable, *, by_place: bool) -> float:
    assert maps.by_place is not None
    assert maps.profile is not None
    errors = []
    for i in range(0, len(maps), 2):
        figures = tuple(maps.by_place[i]) if by_place else None
        at = calibration.at_fat([tuple(maps.profile[i])]).at_places([figures])
        outlying = by_place and not at.knows_places  # one in a hundred
        assert not outlying or "unlike" in at.omissions()[-1]
        a, p = maps.log_amplitude[i : i + 1], maps.log_width[i : i + 1]
        errors.append(float(at.log_size(a, p)[0]) - np.log(maps.d_mm[i]))
    return float(np.std(errors))


@pytest.fixture(scope="module")
def learned_by_place() -> LogQuadratic:
    return learn_log_quadratic(table_by_place(), recipe=RECIPE, learn_fat=learn_fat_process)


def test_figures_by_place_tell_what_bump_and_profile_do_not(learned_by_place) -> None:
    """The control: figures of other bodies take nothing off the error."""
    fresh = table_by_place(150, seed=5)
    without, with_them = (spread_of_errors(learned_by_place, fresh, by_place=by) for by in (False, True))
    assert without > 0.1
    assert with_them < 0.8 * without
    control = learn_log_quadratic(table_by_place(told=False), recipe=RECIPE, learn_fat=learn_fat_process)
    assert spread_of_errors(control, table_by_place(150, seed=5, told=False), by_place=True) > 0.9 * without


def test_without_figures_by_place_the_size_says_so(learned_by_place, learned) -> None:
    one = [tuple(profile_of(np.array([0.1]))[0])]
    bare = learned_by_place.at_fat(one).at_places([None, None])
    assert "under each part of the head" in bare.omissions()[-1]
    assert "feel the lump alone" in bare.omissions()[-1]
    far = learned_by_place.at_fat(one).at_places([(50.0,) * 6])
    assert "unlike any of the calibration's" in far.omissions()[-1]
    assert not far.knows_places
    usual = (1.0, -0.4, -0.2, 0.2, -0.6, -0.3)
    assert learned_by_place.at_fat(one).at_places([usual, None]).omissions() == []
    # a calibration that was learned without them has no use for them
    assert learned.at_fat(one).at_places([usual]).omissions() == []


def test_a_seat_that_the_figures_tell_is_expected_of_the_map(learned_by_place) -> None:
    """Knowing it adds little then; the control is the process without these figures, to which it says a lot."""
    profile, usual = [tuple(profile_of(np.array([0.1]))[0])], np.array([1.0, -0.4, -0.2, 0.2, -0.6, -0.3])
    bare = learned_by_place.at_fat(profile)
    assert bare.hidden is not None
    assert bare.unknowns["seat"] > 0.5
    at = [bare.at_places([tuple(usual + np.eye(6)[1] * seat)]) for seat in (-1.0, 1.0)]
    assert all(one.knows_places and one.unknowns["seat"] < 0.5 * bare.unknowns["seat"] for one in at)
    a, p = np.array([-1.0]), np.array([1.4])
    expected = [float((one.features(a, p) @ one.hidden.expected.T)[0, 0]) for one in at]
    assert expected == pytest.approx([-1.0, 1.0], abs=0.2)


def test_maps_of_a_mass_share_their_mean_figures_by_place(learned_by_place) -> None:
    profile = [tuple(profile_of(np.array([0.1]))[0])]
    usual = np.array([1.0, -0.4, -0.2, 0.2, -0.6, -0.3])
    low, high = tuple(usual - 0.05), tuple(usual + 0.05)
    between = learned_by_place.at_fat(profile).at_places([low, None, high, (50.0,) * 6])
    alone = learned_by_place.at_fat(profile).at_places([tuple(usual)])
    assert isinstance(between, ProcessAtProfile)
    np.testing.assert_allclose(between.profile, alone.profile, atol=1e-12)
    assert between.fat_mm == alone.fat_mm


def test_the_scale_of_figures_by_place_is_not_an_outliers() -> None:
    figures = np.random.default_rng(1).normal(size=(500, 6))
    plain = place_table(figures)
    figures[0] = 1e6
    np.testing.assert_allclose(place_table(figures).scale, plain.scale, rtol=0.02)
    assert np.abs(plain.standardised(np.full(6, 1e6))).max() == 4.0


def test_a_file_holds_the_process_of_figures_by_place(learned_by_place, tmp_path: Path) -> None:
    write_log_quadratic(tmp_path / "s.json", learned_by_place, provenance=Provenance("test", {}, {}))
    read = read_size_calibration(tmp_path / "s.json")
    assert isinstance(read, LogQuadratic)
    profile, a = [tuple(profile_of(np.array([0.1]))[0])], np.array([-2.0, -1.0, 0.0])
    told = [(1.1, -0.2, -0.2, 0.2, -0.6, -0.3)]
    got, want = (one.at_fat(profile).at_places(told) for one in (read, learned_by_place))
    assert got.knows_places
    np.testing.assert_allclose(got.log_size(a, a + 2.4), want.log_size(a, a + 2.4), atol=1e-6)
    assert got.hidden is not None
    assert want.hidden is not None
    np.testing.assert_allclose(got.hidden.expected, want.hidden.expected, atol=1e-6)
    assert got.hidden.most_sd == pytest.approx(want.hidden.most_sd, rel=1e-6)
    document = json.loads((tmp_path / "s.json").read_text())
    inner = document["fat_process"]["with_places"]
    short = inner["hidden"]["by_place"][0].pop()
    (tmp_path / "spoilt.json").write_text(json.dumps(document))
    with pytest.raises(BadDataError, match=r"hidden.by_place is no \(1, 6\)"):
        read_size_calibration(tmp_path / "spoilt.json")
    inner["hidden"]["by_place"][0].append(short)
    del inner["places"]
    (tmp_path / "cut.json").write_text(json.dumps(document))
    with pytest.raises(BadDataError, match="with_places is no process of figures by place"):
        read_size_calibration(tmp_path / "cut.json")
    document["fat_process"]["places"] = learned_by_place_document(tmp_path / "s.json")
    del document["fat_process"]["with_places"]
    (tmp_path / "short.json").write_text(json.dumps(document))
    with pytest.raises(BadDataError, match="points of 5 values, not 11"):
        read_size_calibration(tmp_path / "short.json")


def learned_by_place_document(path: Path) -> object:
    return json.loads(path.read_text())["fat_process"]["with_places"]["places"]


def test_few_bodies_have_no_process() -> None:
    assert learn_fat_process(table(79)) is None


def test_a_file_holds_what_was_learned(learned, tmp_path: Path) -> None:
    write_log_quadratic(tmp_path / "s.json", learned, provenance=Provenance("test", {}, {}))
    read = read_size_calibration(tmp_path / "s.json")
    assert isinstance(read, LogQuadratic)
    assert isinstance(read.with_fat, FatProcess)
    assert json.loads((tmp_path / "s.json").read_text())["form"] == "gaussian-process"
    one = [tuple(profile_of(np.array([0.1]))[0])]
    a, p = np.array([-2.0, -1.0, 0.0]), np.array([1.2, 1.4, 1.6])
    for got, want in ((read.at_fat(one), learned.at_fat(one)),):
        np.testing.assert_allclose(got.log_size(a, p), want.log_size(a, p), atol=1e-6)
        for x, y in zip(
            got.body_and_error(got.terms(a, p), a, p, np.ones(3)),
            want.body_and_error(want.terms(a, p), a, p, np.ones(3)),
            strict=True,
        ):
            np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda part: part["covariance_factor"][7].pop(), "row 8 of covariance_factor has 7 numbers"),
        (lambda part: part["mean"].pop(), "fat_process.mean"),
        (lambda part: part["kernel"]["points"].pop(), "fat_process.mean"),
        (lambda part: part["kernel"].update(scale=-1.0), "kernel.scale"),
    ],
)
def test_a_spoilt_file_is_refused_by_the_field(learned, tmp_path: Path, change, words) -> None:
    path = tmp_path / "s.json"
    write_log_quadratic(path, learned, provenance=Provenance("test", {}, {}))
    document = json.loads(path.read_text())
    change(document["fat_process"])
    path.write_text(json.dumps(document))
    with pytest.raises(BadDataError, match=words):
        read_size_calibration(path)


def test_a_kernel_needs_positive_lengths() -> None:
    make = partial(Kernel, np.zeros((2, 5)))
    with pytest.raises(BadDataError, match="above 0"):
        make(np.array([1.0, 1.0, 0.0, 1.0, 1.0]), 1.0)
