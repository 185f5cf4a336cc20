"""All masses of a map are listed with their sizes, the surest first; no other where there is one lump."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from posterior_maps import bump_values, correlated_field, grid_map
from published_schemas import check_document
from searched_once import searched_once  # noqa: F401 - all tests of this file use it

import tactile_bayes as tb
from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import as_dict, replace
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.findings import finding
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior import masses as masses_module
from tactile_bayes.posterior.bump import Detection
from tactile_bayes.posterior.draw import MapPosterior, ModalBump, SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.masses import by_evidence, with_masses
from tactile_bayes.posterior.result import Estimate, Mass, Rise
from tactile_bayes.posterior.verdict import LIKELY
from tactile_bayes.size.draws import SizePosterior
from tactile_bayes.size.pooling import SizePriors

WIDE, NARROW = (-17.0, 2.0), (16.0, 2.0)


def scene(*, narrow: float, away: float = 33.0, seed: int = 1, half_mm: float = 35.0) -> TactileMap:
    """A wide bump, and a narrow one of some amplitude so far to its right."""
    rng = np.random.default_rng(seed)
    values = bump_values(half_mm=half_mm, x=WIDE[0], y=WIDE[1], sigma_x=6.0, sigma_y=6.0, amplitude=0.3)
    values += bump_values(
        half_mm=half_mm, x=WIDE[0] + away, y=WIDE[1], sigma_x=3.5, sigma_y=3.5, amplitude=narrow, level=0.0
    )
    values += 0.005 * correlated_field(rng, len(values), length_cells=3.0)
    return grid_map(values + 0.005 * rng.standard_normal(values.shape), normalise="gain")


def found_on(tactile_map: TactileMap, **settings: object) -> SizeEstimate:
    return estimate_one(tactile_map, Settings(method="laplace", **settings))


def places(masses: tuple[Mass, ...]) -> list[tuple[float, float]]:
    return [(round(one.x_mm), round(one.y_mm)) for one in masses]


@pytest.mark.long
def test_the_surest_is_reported_though_another_is_sized_larger() -> None:
    estimate = found_on(scene(narrow=0.6)).estimate
    assert places(estimate.masses) == [NARROW, WIDE]
    assert [one.reported for one in estimate.masses] == [True, False]
    surest, larger = (one.largest_mm for one in estimate.masses)
    assert surest is not None
    assert larger is not None
    assert larger > 1.2 * surest
    assert estimate.map_posterior is not None
    assert float(np.median(estimate.map_posterior.x_mm)) == pytest.approx(NARROW[0], abs=0.5)
    assert [round(one.x_mm) for one in estimate.other_rises] == [WIDE[0]]
    # the control: a place that somebody gives is reported
    given = found_on(scene(narrow=0.6), centre_mm=WIDE).estimate
    assert given.masses[1].reported
    assert given.masses[1].largest_mm == pytest.approx(larger, rel=0.02)


@pytest.mark.long
def test_a_shoulder_sized_larger_than_the_lump_beside_it_is_not_reported() -> None:
    """A lump, and a low wide shoulder of the level, as uneven pressure leaves it; `validation.masses` has a hundred."""
    rng = np.random.default_rng(1)
    values = bump_values(half_mm=40.0, x=-16.0, y=2.0, sigma_x=4.5, sigma_y=4.5, amplitude=0.31)
    values += bump_values(half_mm=40.0, x=14.0, y=2.0, sigma_x=9.0, sigma_y=9.0, amplitude=0.12, level=0.0)
    values += 0.003 * correlated_field(rng, len(values), length_cells=3.0)
    masses = found_on(grid_map(values + 0.005 * rng.standard_normal(values.shape), normalise="gain")).estimate.masses
    lump, shoulder = masses
    assert places(masses) == [(-16, 2), (14, 2)]
    assert lump.reported
    assert lump.largest_mm is not None
    assert shoulder.largest_mm is not None
    assert shoulder.largest_mm > 1.5 * lump.largest_mm  # the control: by size it would come first


def ranked(*masses: tuple[float, float | None, float, bool]) -> list[int]:
    """Order of masses of some amplitude, size, evidence, and whether the calibration holds them."""
    outside = (finding("outside_calibration", "outside"),)
    found = []
    for amplitude, size, evidence, held in masses:
        draws = None if size is None else SizePosterior(*[np.full((1, 3), size)] * 2, {}, 0, np.zeros(3))
        estimate = Estimate(
            "no_estimate" if size is None else "estimate",
            "",
            detection=Detection(evidence),
            size=draws,
            bump=ModalBump(amplitude, 0.0, 0.0, 5.0, 5.0),
            findings=() if held else outside,
            code="window" if size is None else "",
        )
        found.append(Mass(0.0, 0.0, 1.0, estimate))
    return [found.index(one) for one in by_evidence(found)]


def test_masses_are_ranked_by_evidence_inside_the_calibration() -> None:
    assert ranked((0.30, 12.0, 40.0, True), (0.25, 24.0, 30.0, True)) == [0, 1]
    assert ranked((0.25, 24.0, 30.0, True), (0.30, 12.0, 40.0, True)) == [1, 0]
    # what the calibration does not hold comes after what it holds, and before what has no size
    assert ranked((0.30, 24.0, 40.0, False), (0.25, 12.0, 30.0, True)) == [1, 0]
    assert ranked((0.30, None, 40.0, True), (0.25, 24.0, 30.0, False)) == [1, 0]
    # but a low shoulder does not go before a lump that is beyond the calibration
    assert ranked((1.50, 32.0, 400.0, False), (0.08, 24.0, 4.5, True)) == [0, 1]


@pytest.mark.long_repeats
@pytest.mark.parametrize("seed", range(3))
def test_one_lump_is_one_mass(seed: int) -> None:
    """`validation.masses` has the share over 200 simulated exams."""
    estimate = found_on(scene(narrow=0.0, seed=seed)).estimate
    assert places(estimate.masses) == [WIDE]
    assert estimate.masses[0].reported


@pytest.mark.long
def test_a_second_lump_in_the_window_is_listed_and_sized() -> None:
    masses = {round(one.x_mm): one for one in found_on(scene(narrow=0.25, away=18.0)).estimate.masses}
    assert sorted(masses) == [WIDE[0], 1]
    choice = masses[int(WIDE[0])].estimate.scene
    assert choice is not None
    assert choice.fit.scene.extra == "second lump"
    (alone,) = (one for one in found_on(scene(narrow=0.25)).estimate.masses if one.x_mm > 0)
    assert alone.largest_mm is not None
    assert masses[1].largest_mm == pytest.approx(alone.largest_mm, rel=0.25)


@pytest.mark.long
def test_a_rise_that_the_map_hardly_shows_is_listed_last_and_without_a_size() -> None:
    rng = np.random.default_rng(1)
    values = bump_values(half_mm=35.0, x=-18.0, y=2.0, sigma_x=4.5, sigma_y=4.5, amplitude=0.5)
    noise = 0.02 * correlated_field(rng, len(values), length_cells=5.0) + 0.005 * rng.standard_normal(values.shape)
    other = bump_values(half_mm=35.0, x=15.0, y=2.0, sigma_x=6.0, sigma_y=6.0, amplitude=0.12, level=0.0)
    estimate = found_on(grid_map(values + other + noise, normalise="gain")).estimate
    lump, low = estimate.masses
    assert lump.reported
    assert (low.largest_mm, low.estimate.code, low.reported) == (None, "prior", False)
    assert LIKELY <= low.probability < lump.probability
    # the control: the errors alone bring none
    assert len(found_on(grid_map(values + noise, normalise="gain")).estimate.masses) == 1


def narrow_bumps(*, second: float, seed: int = 1) -> TactileMap:
    """A narrow bump, and another 5.5 mm from it: less than two widths of what smooths the map for the search."""
    rng = np.random.default_rng(seed)
    values = bump_values(half_mm=30.0, x=-2.0, y=1.0, sigma_x=2.3, sigma_y=2.3, amplitude=0.8)
    values += bump_values(half_mm=30.0, x=3.5, y=1.0, sigma_x=2.3, sigma_y=2.3, amplitude=second, level=0.0)
    values += 0.005 * correlated_field(rng, len(values), length_cells=3.0)
    return grid_map(values + 0.005 * rng.standard_normal(values.shape), normalise="gain")


@pytest.mark.long
def test_two_narrow_bumps_close_to_each_other_are_two_masses_that_may_be_one_lump() -> None:
    document = found_on(narrow_bumps(second=0.7)).answer.document
    assert document is not None
    assert [round(one["centre_mm"]["x"], 0) for one in document["masses"]] in ([-2, 4], [4, -2], [-2, 3], [3, -2])
    (pair,) = document["touching"]
    sizes = [one["max_size_mm"]["median"] for one in document["masses"]]
    assert pair["apart_mm"] == pytest.approx(5.5, abs=0.3)
    assert pair["together_mm"]["median"] == pytest.approx(pair["apart_mm"] + sum(sizes) / 2, rel=1e-6)
    check_document(document, "estimate.schema.json")
    # the control: one bump of that width is one mass
    alone = found_on(narrow_bumps(second=0.0)).answer.document
    assert alone is not None
    assert len(alone["masses"]) == 1
    assert alone["touching"] == []


@pytest.mark.long
def test_a_mass_has_the_size_that_its_place_alone_gives() -> None:
    two = scene(narrow=0.2)
    listed = found_on(two).estimate.masses[1]
    given = found_on(two, centre_mm=NARROW).estimate
    assert given.size is not None
    assert listed.largest_mm == pytest.approx(float(np.nanmedian(given.size.max_size_mm)), rel=0.01)
    # the control: the other mass's size is another
    assert found_on(two).estimate.masses[0].largest_mm != pytest.approx(listed.largest_mm, rel=0.1)


@pytest.mark.long
def test_what_is_known_of_a_lump_is_used_for_the_first_alone() -> None:
    two = scene(narrow=0.6)
    known = found_on(two, known=(("seat", 1.2),)).estimate
    plain = found_on(two).estimate
    assert [one.reported for one in known.masses] == [True, False]
    assert known.masses[0].largest_mm != pytest.approx(plain.masses[0].largest_mm, rel=0.01)
    assert known.masses[1].largest_mm == pytest.approx(plain.masses[1].largest_mm, rel=0.01)


@pytest.mark.long
def test_a_fit_that_moves_to_the_first_lump_gives_no_size() -> None:
    two = scene(narrow=0.2)
    options = SamplerSettings(method="laplace", draws=400, background="free", noise="field")
    first = found_on(two).estimate

    def always_first(_: TactileMap, __: SamplerSettings) -> Estimate:
        return replace(first, masses=(), other_rises=())

    masses = with_masses(two, first, options, always_first).masses
    assert places(masses) == [WIDE, NARROW]
    assert masses[1].largest_mm is None
    assert "does not tell them apart" in masses[1].estimate.reason


@pytest.mark.long
def test_a_mass_that_the_whole_map_does_not_show_has_the_size_of_the_map_less_the_first() -> None:
    """Also far from the first lump, which moves the least-squares start of the whole map."""
    two = scene(narrow=0.2, away=45.0, half_mm=45.0)
    options = SamplerSettings(method="laplace", draws=400, background="free", noise="field")
    first = found_on(two).estimate
    unseen = Estimate("no_estimate", "errors explain it", code="undetected")

    def on_the_rest(a_map: TactileMap, given: SamplerSettings) -> Estimate:
        if a_map is two:
            return unseen
        return estimate_map(a_map, calibration=None, options=given, rng=np.random.default_rng(1))

    masses = with_masses(two, first, options, on_the_rest).masses
    assert places(masses) == [WIDE, (28, 2)]
    assert masses[1].estimate.map_posterior is not None
    # the control: what neither shows is not listed
    assert places(with_masses(two, first, options, lambda *_: unseen).masses) == [WIDE]

    uneven = replace(two, count=np.where(two.y_mm[:, None] < -30.0, 8, two.count))

    def on_all_of_the_rest(a_map: TactileMap, _: SamplerSettings) -> Estimate:
        whole = a_map is not uneven and bool(a_map.covered.all())
        return Estimate("no_estimate", "too narrow", code="unresolved") if whole else unseen

    masses = with_masses(uneven, found_on(uneven).estimate, options, on_all_of_the_rest).masses
    assert [one.estimate.code for one in masses] == ["", "unresolved"]


@pytest.mark.long
def test_json_text_figure_and_python_list_them(tmp_path: Path) -> None:
    write_map(tmp_path / "two.nc", scene(narrow=0.6), provenance=Provenance("import", {}))
    words = ("estimate", "two.nc", "--method", "laplace")
    document = json.loads(run_here(*words, "--json", cwd=tmp_path).stdout)
    check_document(document, "estimate.schema.json")
    masses = document["masses"]
    assert [(one["number"], one["reported"]) for one in masses] == [(1, True), (2, False)]
    assert masses[0]["max_size_mm"] == document["max_size_mm"]
    assert masses[0]["another_exam"] == document["another_exam"]
    assert masses[1]["max_size_mm"]["median"] > masses[0]["max_size_mm"]["median"]
    assert masses[1]["centre_mm"]["x"] == pytest.approx(WIDE[0], abs=0.5)
    assert masses[1]["centre_patient_mm"] is None
    text = run_here(*words, cwd=tmp_path).stdout
    assert "Mass 1 of 2: probability of a lump 0.9" in text
    assert "Mass 2 at (-16.9, 1.9) mm, 33 mm from mass 1: largest size " in text
    assert "a second lump within 20 mm" in text
    bare = json.loads(run_here(*words, "--json", "--size-calibration", "none", cwd=tmp_path).stdout)["masses"]
    assert [one["max_size_mm"] for one in bare] == [None, None]
    assert all(one["reason"] == "no size calibration was given: widths only" for one in bare)
    found = tb.estimate(tmp_path / "two.nc", method="laplace")
    assert [one.number for one in found.masses] == [1, 2]
    assert found.masses[1].max_size_mm is not None
    assert found.masses[1].max_size_mm.median == pytest.approx(masses[1]["max_size_mm"]["median"], abs=1e-6)
    assert found.masses[0].reported
    assert "mass 2" in [text.get_text() for text in found.plot_map().axes[0].texts]
    assert "mass 1" not in [text.get_text() for text in tb.estimate(tb.demo_map()).plot_map().axes[0].texts]


@pytest.mark.long
def test_a_mass_besides_the_reported_one_has_its_axes_their_angle_and_its_ellipse() -> None:
    """The second bump is 5.5 by 3.2 mm wide, its long axis 35 degrees from x towards y."""
    rng = np.random.default_rng(1)
    half = {"half_mm": 35.0}
    values = bump_values(**half, x=WIDE[0], y=WIDE[1], sigma_x=6.0, sigma_y=6.0, amplitude=0.8)
    values += bump_values(
        **half, x=NARROW[0], y=NARROW[1], sigma_x=5.5, sigma_y=3.2, angle_deg=35.0, amplitude=0.4, level=0.0
    )
    values += 0.005 * correlated_field(rng, len(values), length_cells=3.0)
    noisy = values + 0.005 * rng.standard_normal(values.shape)
    found = found_on(grid_map(noisy, normalise="gain"))
    document = found.answer.document
    assert document is not None
    check_document(document, "estimate.schema.json")
    reported, second = document["masses"]
    for name in ("d_x_mm", "d_y_mm", "angle_deg"):
        assert reported[name] == document[name], name  # which are the first mass's
    along, across, angle = (second[name] for name in ("d_x_mm", "d_y_mm", "angle_deg"))
    assert angle["low"] - 1.0 < 35.0 < angle["high"] < 55.0
    assert across["low"] < across["median"] < across["high"] < along["median"] < along["high"]
    assert second["max_size_mm"]["median"] == pytest.approx(along["median"], rel=0.03)
    assert second["position"] is None  # no nipple was touched
    (drawn,) = (one for one in draw_map(found).axes[0].patches if isinstance(one, Ellipse) and not one.get_label())
    long, short = sorted((drawn.get_width(), drawn.get_height()), reverse=True)
    assert (long, short) == pytest.approx((along["median"], across["median"]), rel=1e-6)
    assert drawn.angle % 180.0 == pytest.approx(angle["median"], abs=0.01)


def draw_map(outcome: SizeEstimate) -> Figure:
    return outcome.plot_map()


@pytest.mark.long
def test_both_masses_of_a_shared_scan_are_listed_and_hold(shared_data: Path, tmp_path: Path) -> None:
    """Spheres of 15 and 10 mm, 34 mm apart, by an independent model (truth.csv); a rib was once fitted there."""
    run_here("import", shared_data / "scans" / "s05_two_masses.npz", "-o", "s05.mcap", cwd=tmp_path)
    run_here("map", "s05.mcap", "-o", "s05.nc", cwd=tmp_path)
    masses = json.loads(run_here("estimate", "s05.nc", "--json", cwd=tmp_path).stdout)["masses"]
    assert len(masses) == 2
    for mass, d_mm, x_mm in zip(masses, (15.0, 10.0), (43.0, 77.0), strict=True):
        assert mass["max_size_mm"]["low"] < d_mm < mass["max_size_mm"]["high"]
        assert mass["centre_patient_mm"]["x"] == pytest.approx(x_mm, abs=1.0)
    words = ("estimate", "s05.nc", "--centre-mm", 15, 2, "--json")
    given = json.loads(run_here(*words, cwd=tmp_path).stdout)
    assert given["scene"]["beside"] is None
    assert [mass["reported"] for mass in given["masses"]] == [False, True]


def at_the_rim() -> TactileMap:
    """A lump, and a rise that the map's edge cuts off: to the scene a second lump whose centre lies beyond."""
    rng = np.random.default_rng(1)
    values = bump_values(half_mm=30.0, x=0.0, y=8.0, sigma_x=5.0, sigma_y=5.0, amplitude=0.3)
    values += bump_values(half_mm=30.0, x=1.0, y=33.0, sigma_x=4.0, sigma_y=4.0, amplitude=0.3, level=0.0)
    values += 0.005 * correlated_field(rng, len(values), length_cells=3.0)
    return grid_map(values + 0.005 * rng.standard_normal(values.shape), normalise="gain")


def test_a_second_lump_whose_centre_lies_off_the_map_does_not_end_the_estimate() -> None:
    """It ended in an error about --centre-mm, which nobody had given."""
    estimate = found_on(at_the_rim()).estimate
    assert estimate.scene is not None
    assert estimate.scene.fit.scene.extra == "second lump"
    assert estimate.scene.fit.mode[-2] > 30.5  # its centre's y; the map ends at 30.5 mm
    assert estimate.size is not None
    assert places(estimate.masses) == [(0, 8)]


def test_a_rise_whose_centre_lies_off_the_map_is_a_mass_without_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(masses_module, "other_rises", lambda *_: ((Rise(0.2, 0.0, 31.0, 4.0, 4.0, None, 0.99),), ()))
    masses = found_on(at_the_rim()).estimate.masses
    assert places(masses) == [(0, 8), (0, 31)]
    assert masses[1].estimate.code == "window"
    assert masses[1].estimate.reason == "its centre lies off the map"


def measured(amplitude: float, place: tuple[float, float]) -> Estimate:
    """An estimate with a size whose draws are all alike."""
    bump = ModalBump(amplitude, *place, 4.0, 4.0)
    nothing = {name: np.zeros((1, 3)) for name in ("background", "noise_sd", "angle_rad")}
    draws = {name: np.full((1, 3), value) for name, value in as_dict(bump).items()}
    size = SizePosterior(*[np.full((1, 3), 12.0)] * 2, {}, 0, np.zeros(3))
    drawn = MapPosterior(**nothing | draws)
    return Estimate("estimate", "", detection=Detection(40.0), size=size, bump=bump, map_posterior=drawn)


@pytest.mark.parametrize(("share", "sized"), [(0.2, True), (0.1, False)])
def test_a_lump_that_only_the_map_less_a_much_higher_one_shows_has_no_size(
    monkeypatch: pytest.MonkeyPatch, share: float, sized: bool
) -> None:
    """The misfit of the first is some per cent of it: beside one 13 times as high a size was twice too large."""
    two, first, rise = scene(narrow=0.2), measured(0.3, WIDE), Rise(0.3 * share, *NARROW, 4.0, 4.0, 33.0, 0.99)
    monkeypatch.setattr(masses_module, "other_rises", lambda *_: ((rise,), ()))
    unseen = Estimate("no_estimate", "errors explain it", code="undetected")

    def by_the_rest(a_map: TactileMap, _: SamplerSettings) -> Estimate:
        return unseen if a_map is two else measured(rise.amplitude, NARROW)

    masses = with_masses(two, first, SamplerSettings(), by_the_rest).masses
    assert places(masses) == [WIDE, NARROW]
    assert (masses[1].largest_mm is not None) == sized
    told = "it stands in the flank of a lump more than 7 times as high, which hides its shape"
    assert masses[1].estimate.reason == ("" if sized else told)
    # what the whole map shows by itself has a size, however low
    masses = with_masses(two, first, SamplerSettings(), lambda *_: measured(rise.amplitude, NARROW)).masses
    assert masses[1].largest_mm == 12.0


def test_a_second_lump_of_the_window_that_nothing_shows_by_itself_is_listed_without_a_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    two, rise = scene(narrow=0.2), Rise(0.1, *NARROW, 4.0, 4.0, 33.0, 0.99)
    unseen = Estimate("no_estimate", "errors explain it", code="undetected")
    beside, elsewhere = "_second_lump_of_scene", "other_rises"
    for of_scene, of_map, reasons in (
        ([rise], ((), ()), ["", "the map shows it beside the first lump only, not by itself"]),
        ([], ((rise,), ()), [""]),
        ([], ((), (rise,)), ["", "the map shows too little of it for a size"]),
    ):
        monkeypatch.setattr(masses_module, beside, lambda *_, found=of_scene: found)
        monkeypatch.setattr(masses_module, elsewhere, lambda *_, found=of_map: found)
        masses = with_masses(two, measured(0.3, WIDE), SamplerSettings(), lambda *_: unseen).masses
        assert [one.estimate.reason for one in masses] == reasons


@pytest.mark.parametrize(("share", "listed"), [(0.2, True), (0.1, False)])
def test_a_rise_without_proof_is_listed_only_where_it_has_a_share_of_the_lumps_height(
    monkeypatch: pytest.MonkeyPatch, share: float, listed: bool
) -> None:
    two, lump = scene(narrow=0.2), measured(0.3, WIDE)
    found = measured(0.3 * share, NARROW).bump
    for log_odds, expected in ((1.0, listed), (10.0, True)):  # the control: with proof it needs none
        assessed = SimpleNamespace(detection=Detection(log_odds), bump=lambda: found)
        monkeypatch.setattr(masses_module, "search", lambda *_, one=assessed: ((), one))
        rise, proven = masses_module._assessed_rise(NARROW, two, two, lump, SamplerSettings())
        assert ((rise is not None), proven) == (expected, log_odds > 5.0)


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (SamplerSettings(), 1),
        (SamplerSettings(centre_mm=WIDE), 0),
        (SamplerSettings(size_priors=SizePriors(known={"depth_mm": 15.0})), 0),
        (SamplerSettings(size_priors=SizePriors(known={"fat_stiffness": 1.0})), 1),
    ],
    ids=["the surest", "the place that was given", "whose depth is known", "what is known of the body"],
)
def test_the_lump_that_was_asked_about_stays_the_answer_beside_a_surer_one(
    monkeypatch: pytest.MonkeyPatch, options: SamplerSettings, reported: int
) -> None:
    two, first = scene(narrow=0.2), measured(0.3, WIDE)
    surer = replace(measured(0.3, NARROW), detection=Detection(80.0))
    rise = Rise(0.3, *NARROW, 4.0, 4.0, 33.0, 0.99)
    monkeypatch.setattr(masses_module, "other_rises", lambda *_: ((rise,), ()))
    answer = with_masses(two, first, options, lambda *_: surer)
    assert places(answer.masses) == [NARROW, WIDE]
    assert [one.reported for one in answer.masses] == [reported == 1, reported == 0]
    assert answer.bump == (first, surer)[reported].bump
    assert all(0.9 < one.probability <= 0.99 for one in answer.masses)  # calibrated; by their odds both are 1
    (other,) = answer.other_rises
    assert (other.x_mm, other.distance_mm) == ((NARROW, WIDE)[reported][0], 33.0)


def test_a_place_is_clear_of_both_lumps_of_a_scene_by_twice_their_larger_width(monkeypatch: pytest.MonkeyPatch) -> None:
    two, lump = scene(narrow=0.2), measured(0.3, WIDE)
    drawn = replace(lump.map_posterior, sigma_y_mm=np.full((1, 3), 8.0))
    estimate = replace(lump, map_posterior=drawn)

    def clear(x: float) -> bool:
        return masses_module._clear_of_lump(x, WIDE[1], two, estimate)

    assert [clear(WIDE[0] + away) for away in (9.0, 15.0, 17.0, 33.0)] == [False, False, True, True]
    for second, expected in ((NARROW, False), ((90.0, 2.0), True)):  # off the map it stands for a rise at the rim
        bump = ModalBump(0.0, *second, 4.0, 4.0)
        monkeypatch.setattr(masses_module, "_second_lump", lambda _, one=bump: one)
        assert clear(NARROW[0] + 7.0) == expected


@pytest.mark.parametrize(("away", "count"), [(3.0, 2), (9.0, 3)])
def test_two_rises_whose_fits_meet_are_one_mass(monkeypatch: pytest.MonkeyPatch, away: float, count: int) -> None:
    two, beside = scene(narrow=0.2), (NARROW[0] + away, NARROW[1])
    rises = tuple(Rise(0.2, *place, 4.0, 4.0, 33.0, 0.99) for place in (NARROW, (NARROW[0] + 12.0, NARROW[1])))
    monkeypatch.setattr(masses_module, "other_rises", lambda *_: (rises, ()))

    def fitted(_: TactileMap, options: SamplerSettings) -> Estimate:
        return measured(0.2, NARROW if options.centre_mm == NARROW else beside)

    assert len(with_masses(two, measured(0.3, WIDE), SamplerSettings(), fitted).masses) == count
