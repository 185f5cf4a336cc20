"""The trade-off of the forward models: what is measured, what is advised, and what it refuses."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable
from itertools import count
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from click.testing import CliRunner
from published_schemas import check_document

from tactile_bayes.actions import tradeoff as tradeoff_forward
from tactile_bayes.commands.laboratory import tradeoff_forward_command
from tactile_bayes.declarations import replace, to_plain
from tactile_bayes.errors import EXIT_BAD_DATA, EXIT_USAGE, BadDataError
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.forward.scene import Head, Lump, Scene
from tactile_bayes.forward.tissue import Rib, SceneBody, SolidLump
from tactile_bayes.presets import HEADS, SHOULDERS_INSIDE, SHOULDERS_OUTSIDE
from tactile_bayes.report.tradeoff import draw_tradeoffs, tradeoff_file, tradeoff_text
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws, ShapePrior
from tactile_bayes.size.eq6 import SizeCalibration
from tactile_bayes.size.pooling import SizePriors, pooled_size
from tactile_bayes.studies import tradeoffs
from tactile_bayes.studies.estimate_tradeoff import SIZE, StudyRun, Tradeoff
from tactile_bayes.studies.paper import Geometry, MapFit, StudyRow, StudySettings
from tactile_bayes.studies.paper_solid import SolidSettings
from tactile_bayes.studies.tradeoffs import (
    PLANE,
    SOLID,
    LumpCase,
    SizeRule,
    calibrated_rule,
    dimensions_note,
    learned_rule,
    lump_case,
    measure_forward,
)
from tactile_bayes.studies.tradeoffs import forward_settings as settings_of

Run = Callable[..., "CompletedProcess[str]"]
BALL = SolidLump(seat=0.0)
CASE = lump_case(Scene(body=SceneBody(), solid_lumps=(BALL,)))
RULE = SizeRule(lambda _, x, y: max(3 * x, 3 * (y or 0.0)), 0.12, "a rule")


def off_of(settings: StudySettings | SolidSettings) -> float:
    """Made-up errors of a width: the finer the smaller, of a head without its rim large."""
    if isinstance(settings, SolidSettings) and settings.head.rim_mm == 0.0:
        return 0.4
    finest = 4 if isinstance(settings, StudySettings) else 3
    return {1: 0.05, 2: 0.002, 3: 0.001, finest: 0.0}[settings.fineness]


def by_model(case: LumpCase = CASE, rule: SizeRule = RULE, share: float = 0.005) -> dict[str, Tradeoff]:
    """Made-up measurements: the finer, the dearer and the nearer to a = 0.3, sigma = 5 mm."""
    spent = [0.0]

    def maps(
        settings: StudySettings | SolidSettings, _body: object
    ) -> Callable[[float], StudySettings | SolidSettings]:
        spent[0] += 0.1 * settings.fineness**2
        return lambda _: settings

    def fitted(_settings: object, made: StudySettings | SolidSettings) -> MapFit:
        spent[0] += 0.1
        off = off_of(made)
        along = 4 * (1 + off) if isinstance(made, SolidSettings) else None
        return MapFit(0.3, (5 * (1 + off), along), 0.0)

    with pytest.MonkeyPatch.context() as patch:
        for kind in (StudySettings, SolidSettings):
            patch.setattr(kind, "maps", maps)
            patch.setattr(kind, "fitted", fitted)
        patch.setattr(tradeoffs, "_empirical", lambda case: lambda _: replace(case.plane, fineness=1))
        work = StudyRun(lambda: spent[0], 1.0, 1)
        return {model: measure_forward(case, model, rule, share=share, work=work) for model in (PLANE, SOLID)}


def test_each_model_has_one_default_and_a_finer_reference() -> None:
    for model in (PLANE, SOLID):
        settings, finest = settings_of(CASE, model)
        (default,) = (one.options.settings for one in settings if one.default)
        assert default == (CASE.plane if model == PLANE else CASE.solid)
        assert finest.options.settings.fineness > max(one.options.settings.fineness for one in settings if one.usable)
    assert [one.label for one in settings_of(CASE, PLANE)[0] if one.options.empirical] == ["Eqs 1 to 4"]


@pytest.mark.long
def test_the_default_plane_setting_is_the_study(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = count()
    monkeypatch.setattr(tradeoffs, "_PLANE", ((2, 0.25), (1, 0.5)))
    found = measure_forward(CASE, PLANE, RULE, share=0.005, work=StudyRun(lambda: float(next(ticks)), 1.0, 2))
    (row,) = StudySettings().rows(Geometry(0.0, 15.0, 1.0, (100.0,)))
    told = {name: one.median for name, one in found.default.answer.quantities.items()}
    assert (told["amplitude"], told["sigma_x_mm"]) == pytest.approx((row.amplitude, row.sigma_x_mm), rel=1e-9)
    assert (found.default.cpu_s, found.default.runs) == ({"lump": 1.0, "map": 1.0}, 2)
    assert "sigma_y_mm" not in told
    assert told["element_mm"] == pytest.approx(0.74, abs=0.01)  # half of 47.1 mm over 32 elements


def test_a_scene_gives_its_body_and_head_to_both_models() -> None:
    body = SceneBody(fat_kpa=4.0, gland_ratio=6.0, thickness_mm=50.0, nu=0.49, fat_mm=16.0)
    scene = Scene(body=body, solid_lumps=(SolidLump(d_mm=12.0, depth_ratio=0.9),), head=Head(radius_mm=40.0))
    case = lump_case(scene)
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
    cases = {head: lump_case(scene, head=head) for head in (None, *HEADS)}
    plain, inside, outside = cases.values()
    assert (plain.plane, plain.solid) == (inside.plane, outside.solid)  # each model's default, by name
    heads = {name: [case.settings(model).head.shoulders for model in (PLANE, SOLID)] for name, case in cases.items()}
    assert heads == {None: [SHOULDERS_INSIDE, SHOULDERS_OUTSIDE]} | {head: [head, head] for head in HEADS}
    assert inside.solid.head.surface_mm()[0, 0, 2] < outside.solid.head.surface_mm()[0, 0, 2]
    seen = [case.plane.fitted(case.plane.maps(case.body)(100.0)).amplitude for case in (inside, outside)]
    assert seen[1] > 1.2 * seen[0]


@pytest.mark.parametrize(("head", "edge"), [(None, "rim"), (SHOULDERS_INSIDE, "shoulders")])
def test_the_head_without_its_edge_is_another_head(head: str | None, edge: str) -> None:
    case = lump_case(Scene(body=SceneBody(), solid_lumps=(BALL,)), head=head)
    (bare,) = (one for one in settings_of(case, SOLID)[0] if one.axis == "head")
    assert bare.label == f"head without {edge}"
    assert (bare.options.settings.head.shoulder_mm, bare.options.settings.head.rim_mm) == (0.0, 0.0)
    assert bare.options.settings != case.solid


@pytest.mark.parametrize("head", [None, *HEADS])
def test_the_command_hands_its_head_on_and_names_it(head: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = by_model()
    monkeypatch.setattr(tradeoff_forward.tradeoffs, "measure_forward", lambda _case, model, *_, **__: made[model])
    words = [] if head is None else ["--head", head]
    found = {form: CliRunner().invoke(tradeoff_forward_command, [*words, *form]) for form in ((), ("--json",))}
    case, documents = (
        lump_case(Scene(body=SceneBody(), solid_lumps=(BALL,)), head=head),
        json.loads(found[("--json",)].stdout),
    )
    for model, document in zip((PLANE, SOLID), documents, strict=True):
        check_document(document, "tradeoff.schema.json")
        kept, shoulders = document["provenance"]["settings"], case.settings(model).head.shoulders
        assert (kept["model"], kept["d_mm"], kept["head"]) == (model, 15.0, shoulders)
        title = f"{model}: lump of 15 mm, h/d 1, 100 times as stiff as fat, centred; head: {shoulders}"
        assert title in found[()].stdout


def test_eq_6_is_learned_axis_by_axis_and_says_what_it_leaves() -> None:
    level = 0.6 ** (1 / 0.3)  # the amplitude at which 0.6 a^-0.3 is 1
    rows = []
    for d in (10.0, 15.0, 20.0):
        for h, a in ((0.8, 0.9), (1.0, level), (1.2, 0.05)):
            change = 0.6 * a**-0.3
            x, y = (d + 5) / 6 * change, (d + 2) / 5 * change
            rows.append(StudyRow("centred", d, h, 100.0, a, x, 0.0, True, y))
    rule = learned_rule(rows)
    assert rule.size_mm(0.9, rows[0].sigma_x_mm, rows[0].sigma_y_mm) == pytest.approx(10.0)
    assert rule.size_mm(0.9, 0.0, rows[0].sigma_y_mm) == pytest.approx(10.0)
    assert np.isnan(rule.size_mm(0.0, 5.0, 4.0))
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
    size = rule.size_mm(a, x, y)
    p, q = 0.5 * np.log(x * y), float(quadratic.round_excess(np.log(np.array(a)), 0.5 * np.log(np.array(x * y))))
    draws = ShapeDraws(np.full(8000, np.log(a)), np.full(8000, p), np.full(8000, q), np.zeros(8000))
    priors = SizePriors(shape=ShapePrior(oval_probability=1e-12))
    pooled = pooled_size([draws], calibration=quadratic, priors=priors, rng=np.random.default_rng(3))
    spread = float(np.std(np.log(pooled.d_x_mm)))
    assert np.median(np.log(pooled.d_x_mm)) == pytest.approx(np.log(size), abs=4 * 1.25 * spread / np.sqrt(8000))
    # the control: the widest of two sizes by each width, as Eq 6 has it, is another number
    assert max(rule.size_mm(a, x, None), rule.size_mm(a, y, None)) > 1.05 * size
    assert rule.size_mm(a, x, None) == pytest.approx(rule.size_mm(a, x, x))


def test_each_form_says_what_it_leaves_and_where_it_ends() -> None:
    by_fat = "Eq 6 and its residual of file.json at an average depth of fat (`estimate` reads it from the frames)"
    for name, words in (("solid-mean", by_fat), ("plane-strain", "Eq 6 of file.json")):
        rule = calibrated_rule(shipped(name), name="file.json")
        assert rule.source == words
        assert 0.05 < rule.scatter < 0.4
        assert rule.outside(0.3, 5.0, 4.0) == []
        (said, *_) = rule.outside(30.0, 5.0, 4.0)
        assert "amplitude 30 (table: " in said


def test_the_change_in_size_is_told_in_mm_and_percent() -> None:
    found = by_model()[SOLID]
    assert found.default.median_off_mm == pytest.approx(15.0 * 0.002)
    size = found.default.answer.quantities[SIZE]
    assert size.high / size.median == pytest.approx(np.exp(1.96 * 0.12), rel=1e-4)
    text = tradeoff_text({"a lump": found})
    assert re.search(r"\* fineness 2 +0\.400 +0\.100 +15\.03 +11\.88 to 19\.02 +0\.032 +0\.009", text)
    assert re.search(r"the finest +0\.87 +0\.3000 +5\.000 +4\.000\n", text)
    assert re.search(r"fineness 2 +1\.39 +0\.3000 +5\.010 +4\.008 +\+0\.00 +\+0\.20 +\+0\.20 +\+0\.20", text)


def test_a_calibration_without_sizes_or_not_there_is_refused(run_cli: Run, tmp_path: Path) -> None:
    done = run_cli("tradeoff", "forward", "--size-calibration", "none", cwd=tmp_path)
    assert done.returncode == EXIT_USAGE
    assert "gives no sizes" in done.stderr
    done = run_cli("tradeoff", "forward", "--size-calibration", "mine.json", cwd=tmp_path)
    assert done.returncode == EXIT_BAD_DATA
    assert "mine.json" in done.stderr


def test_the_advice_names_the_cheapest_that_is_enough() -> None:
    made = by_model()
    assert (made[PLANE].tolerance_mm, made[SOLID].tolerance_mm) == (0.075, 0.075)
    text = tradeoff_text(made)
    assert "Advice: fineness 2 (the default): 0.50 s, interval ends within 0.032 mm" in text
    assert "What moves the ends more than 0.075 mm: fineness 1 0.8 mm; head without rim 6.3 mm." in text
    assert "Sizes by a rule, which itself leaves 12 % (SD of ln d)" in text
    assert text.count("the interval is what the calibration leaves") == 2
    assert "lies outside that interval" not in text
    far = by_model(rule=replace(RULE, largest=lambda _a, x, _y: 2 * x))
    assert "The lump of 15 mm lies outside that interval, as its body is not the calib" in tradeoff_text(far)
    strict = by_model(share=1e-9)
    assert strict[SOLID].cheapest_sufficient() is None
    assert "no setting has its interval ends within" in tradeoff_text(strict)
    none = by_model(rule=replace(RULE, largest=lambda *_: float("nan")))[SOLID]
    assert SIZE not in none.default.answer.quantities
    assert none.default.median_off_mm == pytest.approx(5.0 * 0.002)  # then the width is what is compared
    assert re.search(r"sigma +95 % interval", tradeoff_text({"": none}))


def test_what_two_dimensions_get_wrong_is_reported() -> None:
    made = by_model()
    said = dimensions_note(CASE, made[PLANE], made[SOLID], {PLANE: RULE, SOLID: RULE})
    assert "+0.0 % in width against a ball; a cylinder's map read by the same calibration gives 15.0 mm for 15" in said
    other = replace(RULE, source="another rule", largest=lambda _a, x, _y: 6 * x)
    said = dimensions_note(CASE, made[PLANE], made[SOLID], {PLANE: other, SOLID: RULE})
    assert "a ball's map read by the cylinder's calibration gives 30.0 mm for 15: no mesh mends that." in said


def test_the_document_is_the_one_of_all_trade_offs() -> None:
    for model, made in by_model().items():
        document = json.loads(json.dumps(to_plain(tradeoff_file(made, varied="forward", provenance={}))))
        check_document(document, "tradeoff.schema.json")
        assert len(document["settings"]) == len(settings_of(CASE, model)[0])
        assert document["reference"]["words"].startswith(f"{model}, fineness")


@pytest.mark.long
def test_the_figure_is_the_same_bytes_each_time(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        draw_tradeoffs(by_model(), tmp_path / name)
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
        lump_case(scene)


def test_a_scene_that_cannot_be_is_told_with_its_file(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[[lump]]\namplitude = 0.2\n")
    done = run_cli("tradeoff", "forward", "s.toml", cwd=tmp_path)
    assert done.returncode == EXIT_BAD_DATA
    assert done.stderr.splitlines()[-1].startswith("error: s.toml: the scene has bumps")


@pytest.mark.slow
def test_the_command_measures_draws_and_advises(run_cli: Run, tmp_path: Path) -> None:
    done = run_cli("tradeoff", "forward", "--figure", "t.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "* fineness 2" in done.stdout
    assert "Sizes by Eq 6 and its residual of solid_mean.json" in done.stdout
    assert "Sizes by Eq 6 of plane_strain.json" in done.stdout
    assert "Advice: fineness 1" in done.stdout  # elements of 1.5 mm are enough for 0.5 % in this cylinder's size
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
