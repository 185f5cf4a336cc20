"""The trade-off of the forward models: what is measured, what is advised, and what it refuses."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from itertools import count
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from click.testing import CliRunner

from tactile_bayes.actions import tradeoff as tradeoff_forward
from tactile_bayes.commands.laboratory import tradeoff_forward_command
from tactile_bayes.declarations import replace
from tactile_bayes.errors import EXIT_BAD_DATA, EXIT_USAGE, BadDataError
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.forward.scene import Head, Lump, Scene
from tactile_bayes.forward.tissue import Rib, SceneBody, SolidLump
from tactile_bayes.presets import HEADS, SHOULDERS_INSIDE, SHOULDERS_OUTSIDE
from tactile_bayes.report.laboratory import TradeoffReport, tradeoff_document, tradeoff_text
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws, ShapePrior
from tactile_bayes.size.eq6 import SizeCalibration
from tactile_bayes.size.pooling import SizePriors, pooled_size
from tactile_bayes.studies.paper import Geometry, StudyRow, StudySettings
from tactile_bayes.studies.tradeoffs import (
    EMPIRICAL,
    PLANE,
    SOLID,
    LumpCase,
    Measured,
    SizeRule,
    calibrated_rule,
    case_of,
    learned_rule,
)
from tactile_bayes.studies.tradeoffs import forward_settings as settings_of
from tactile_bayes.studies.tradeoffs import measure_forward as measure

Run = Callable[..., "CompletedProcess[str]"]
BALL = SolidLump(seat=0.0)
CASE = case_of(Scene(body=SceneBody(), solid_lumps=(BALL,)))
SETTINGS = settings_of(CASE)


def report(case: LumpCase = CASE) -> TradeoffReport:
    """Made-up measurements: the finer, the dearer and the nearer to a = 0.3, sigma = 5 mm."""
    found = []
    for setting in SETTINGS:
        fineness = setting.settings.fineness
        off = {"reference": 0.0, "default": 0.002, "rim": 0.4}.get(setting.kind, 0.004 if fineness > 1 else 0.05)
        sigma_y = 4.0 * (1 + off) if setting.model == SOLID else None
        found.append(Measured(setting, 3 / fineness, 0.1 * fineness**2, 0.1, 0.3, 5.0 * (1 + off), sigma_y))
    rule = SizeRule(lambda _, x, y: [3 * x, 3 * (y or 0.0)], 0.12, "a rule")
    return TradeoffReport(case, tuple(found), {PLANE: rule, SOLID: rule}, 0.005)


def test_each_model_has_one_default_and_one_reference() -> None:
    for model in (PLANE, SOLID):
        kinds = [setting.kind for setting in SETTINGS if setting.model == model]
        assert kinds.count("default") == kinds.count("reference") == 1
        (default,) = (one for one in SETTINGS if one.model == model and one.kind == "default")
        assert default.settings == (CASE.plane if model == PLANE else CASE.solid)
    assert [setting.model for setting in SETTINGS].count(EMPIRICAL) == 1


def test_the_default_plane_setting_is_the_study() -> None:
    (setting,) = (one for one in SETTINGS if one.model == PLANE and one.kind == "default")
    ticks = count()
    found = measure(CASE, setting, clock=lambda: float(next(ticks)), runs=2)
    (row,) = StudySettings().rows(Geometry(0.0, 15.0, 1.0, (100.0,)))
    assert (found.amplitude, found.sigma_x_mm) == pytest.approx((row.amplitude, row.sigma_x_mm), rel=1e-9)
    assert (found.lump_s, found.map_s, found.sigma_y_mm) == (1.0, 1.0, None)
    assert found.element_mm == pytest.approx(0.74, abs=0.01)  # half of 47.1 mm over 32 elements


def test_a_scene_gives_its_body_and_head_to_both_models() -> None:
    body = SceneBody(fat_kpa=4.0, gland_ratio=6.0, thickness_mm=50.0, nu=0.49, fat_mm=16.0)
    scene = Scene(body=body, solid_lumps=(SolidLump(d_mm=12.0, depth_ratio=0.9),), head=Head(radius_mm=40.0))
    case = case_of(scene)
    assert case.seat == pytest.approx((16.0 - 10.8) / 6.0)
    for settings in (case.plane, case.solid):
        assert (settings.fat_kpa, settings.gland_ratio, settings.thickness_mm, settings.poisson) == (
            4.0,
            6.0,
            50.0,
            0.49,
        )
        assert settings.head.radius_mm == 40.0


def test_the_head_is_that_of_both_models_and_moves_their_numbers() -> None:
    scene = Scene(body=SceneBody(), solid_lumps=(SolidLump(depth_ratio=1.5, seat=0.0),))
    cases = {head: case_of(scene, head=head) for head in (None, *HEADS)}
    plain, inside, outside = cases.values()
    assert (plain.plane, plain.solid) == (inside.plane, outside.solid)  # each model's default, by name
    assert plain.heads == {PLANE: SHOULDERS_INSIDE, SOLID: SHOULDERS_OUTSIDE}
    for head in HEADS:
        assert cases[head].heads == dict.fromkeys((PLANE, SOLID), head)
    assert inside.solid.head.surface_mm()[0, 0, 2] < outside.solid.head.surface_mm()[0, 0, 2]
    seen = []
    for case in (inside, outside):
        setting = next(one for one in settings_of(case) if one.model == PLANE)
        seen.append(measure(case, setting, clock=lambda: 0.0).amplitude)
    assert seen[1] > 1.2 * seen[0]


@pytest.mark.parametrize(("head", "edge"), [(None, "rim"), (SHOULDERS_INSIDE, "shoulders")])
def test_the_head_without_its_edge_is_another_head(head: str | None, edge: str) -> None:
    case = case_of(Scene(body=SceneBody(), solid_lumps=(BALL,)), head=head)
    (bare,) = (one for one in settings_of(case) if one.kind == "rim")
    assert bare.label == f"head without its {edge}"
    assert (bare.settings.head.shoulder_mm, bare.settings.head.rim_mm) == (0.0, 0.0)
    assert bare.settings != case.solid


@pytest.mark.parametrize("head", [None, *HEADS])
def test_the_command_hands_its_head_on_and_names_it(head: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff_forward, "run_tradeoff", lambda case, *_, **__: report(case))
    words = [] if head is None else ["--head", head]
    found = {form: CliRunner().invoke(tradeoff_forward_command, [*words, *form]) for form in ((), ("--json",))}
    heads = case_of(Scene(body=SceneBody(), solid_lumps=(BALL,)), head=head).heads
    assert json.loads(found[("--json",)].stdout)["head"] == heads
    assert f"head: {heads[PLANE]} (plane-strain), {heads[SOLID]} (solid)" in found[()].stdout


def test_eq_6_is_learned_axis_by_axis_and_says_what_it_leaves() -> None:
    level = 0.6 ** (1 / 0.3)  # the amplitude at which 0.6 a^-0.3 is 1
    rows = []
    for d in (10.0, 15.0, 20.0):
        for h, a in ((0.8, 0.9), (1.0, level), (1.2, 0.05)):
            change = 0.6 * a**-0.3
            x, y = (d + 5) / 6 * change, (d + 2) / 5 * change
            rows.append(StudyRow("centred", d, h, 100.0, a, x, 0.0, True, y))
    rule = learned_rule(rows)
    assert rule.sizes(0.9, rows[0].sigma_x_mm, rows[0].sigma_y_mm) == pytest.approx([10.0, 10.0])
    assert rule.scatter < 1e-9


@functools.cache
def shipped(name: str) -> SizeCalibration | BodyCalibration:
    path = size_calibration_path(name)
    assert path is not None
    return read_size_calibration(path)


def test_a_quadratic_gives_the_median_of_what_estimate_draws() -> None:
    """Draws of a map that says a and the widths exactly, through all that `estimate` adds: a round lump's median."""
    quadratic = shipped("solid-mean")
    assert isinstance(quadratic, BodyCalibration)
    a, x, y = 0.3, 5.2, 4.0
    rule = calibrated_rule(quadratic, name="solid.json")
    (size,) = rule.sizes(a, x, y)
    p, q = 0.5 * np.log(x * y), float(quadratic.round_excess(np.log(np.array(a)), 0.5 * np.log(np.array(x * y))))
    draws = ShapeDraws(np.full(8000, np.log(a)), np.full(8000, p), np.full(8000, q), np.zeros(8000))
    priors = SizePriors(shape=ShapePrior(oval_probability=1e-12))
    pooled = pooled_size([draws], calibration=quadratic, priors=priors, rng=np.random.default_rng(3))
    spread = float(np.std(np.log(pooled.d_x_mm)))
    assert np.median(np.log(pooled.d_x_mm)) == pytest.approx(np.log(size), abs=4 * 1.25 * spread / np.sqrt(8000))
    # the control: the widest of two sizes by each width, as Eq 6 has it, is another number
    assert max(rule.sizes(a, x, None)[0], rule.sizes(a, y, None)[0]) > 1.05 * size
    assert rule.sizes(a, x, None) == pytest.approx(rule.sizes(a, x, x))


def test_each_form_says_what_it_leaves_and_where_it_ends() -> None:
    for name, words in (("solid-mean", "Eq 6 and its residual of file.json"), ("plane-strain", "Eq 6 of file.json")):
        rule = calibrated_rule(shipped(name), name="file.json")
        assert rule.source == words
        assert 0.05 < rule.scatter < 0.4
        found = report().found[-1]
        assert rule.outside(found) == []
        (said, *_) = rule.outside(replace(found, amplitude=30.0))
        assert said.startswith("amplitude 30 (table: ")


def test_the_change_in_size_is_told_in_mm() -> None:
    made = report()
    (default,) = (one for one in made.of(SOLID) if one.setting.kind == "default")
    assert made.size_change_mm(default) == pytest.approx(15.0 * 0.002)
    text = tradeoff_text(made)
    assert "the default mesh leaves +0.2 % (+0.030 mm)" in text
    line, _ = (line for line in text.splitlines() if line.startswith("solid, fineness 2 (default)"))
    assert line.endswith("+0.20  +0.030")


def test_a_calibration_without_sizes_or_not_there_is_refused(run_cli: Run, tmp_path: Path) -> None:
    done = run_cli("tradeoff", "forward", "--size-calibration", "none", cwd=tmp_path)
    assert done.returncode == EXIT_USAGE
    assert "gives no sizes" in done.stderr
    done = run_cli("tradeoff", "forward", "--size-calibration", "mine.json", cwd=tmp_path)
    assert done.returncode == EXIT_BAD_DATA
    assert "mine.json" in done.stderr


def test_the_advice_names_the_cheapest_that_is_enough() -> None:
    made = report()
    text = tradeoff_text(made)
    assert "solid: fineness 2 (elements of 1.5 mm) keeps the size within 0.5 % at 0.50 s CPU" in text
    assert "a mesh finer than 1.5 mm is wasted below that, the finest costs 2 times as much" in text
    assert "plane-strain: fineness 2, cell 0.5 mm" in text
    assert "a rule, which itself leaves 12 % (SD of ln d)" in text
    strict = replace(made, tolerance=1e-9)
    assert "solid: only the finest setting keeps the size within" in tradeoff_text(strict)
    none = SizeRule(lambda *_: [float("nan")], 0.12, "a rule")
    assert "solid: only the finest setting" in tradeoff_text(replace(made, rules={PLANE: none, SOLID: none}))


def test_the_document_is_plain_data() -> None:
    document = json.loads(json.dumps(tradeoff_document(report())))
    assert len(document["settings"]) == len(SETTINGS)
    (finest,) = (row for row in document["settings"] if (row["model"], row["kind"]) == (SOLID, "reference"))
    assert finest["size_error"] == 0.0


def test_the_figure_is_the_same_bytes_each_time(tmp_path: Path) -> None:
    from tactile_bayes.report.laboratory import draw_tradeoff

    for name in ("one.png", "two.png"):
        draw_tradeoff(report(), tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


REFUSED = {
    "bumps": (Scene(lumps=(Lump(),)), "the scene has bumps; give one lump of tissue"),
    "none": (Scene(), "the scene has 0 lumps"),
    "two": (Scene(solid_lumps=(BALL, replace(BALL, x_mm=30.0))), "the scene has 2 lumps"),
    "rib": (Scene(solid_lumps=(BALL,), ribs=(Rib(),)), "the scene has a rib"),
    "flat": (Scene(solid_lumps=(replace(BALL, height_mm=8.0),)), r"lump\[0\].height_mm is 8"),
    "high": (Scene(solid_lumps=(replace(BALL, seat=2.5),)), "seat is 2.5"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_one_ball_is_refused(name: str) -> None:
    scene, words = REFUSED[name]
    with pytest.raises(BadDataError, match=words):
        case_of(scene)


def test_a_scene_that_cannot_be_is_told_with_its_file(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[[lump]]\namplitude = 0.2\n")
    done = run_cli("tradeoff", "forward", "s.toml", cwd=tmp_path)
    assert done.returncode == EXIT_BAD_DATA
    assert done.stderr.splitlines()[-1].startswith("error: s.toml: the scene has bumps")


@pytest.mark.slow
def test_the_command_measures_draws_and_advises(run_cli: Run, tmp_path: Path) -> None:
    done = run_cli("tradeoff", "forward", "--figure", "t.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "solid: fineness 2" in done.stdout
    assert "sizes by Eq 6 and its residual of solid_mean.json" in done.stdout
    assert "sizes by Eq 6 of plane_strain.json" in done.stdout
    assert "plane-strain: fineness 1" in done.stdout  # elements of 1.5 mm are enough for 0.5 % in this lump's size
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
