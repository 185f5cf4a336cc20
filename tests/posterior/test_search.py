"""Which rise of a map is taken for the lump."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import bump_map, bump_values, grid_map
from scipy.ndimage import gaussian_filter

from tactile_bayes.declarations import replace
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior import estimate
from tactile_bayes.posterior.bump import Detection, levelled
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.verdict import NO_EVIDENCE, cut_by_rim
from tactile_bayes.posterior.white import BumpFit, Candidate, WhiteAssessment

FIELD = SamplerSettings(method="laplace", background="free", rotation="off", noise="field")


def noise(seed: int, n: int = 81) -> np.ndarray:
    return 0.01 * np.random.default_rng(seed).standard_normal((n, n))


def look(tactile_map: TactileMap, *, rotation: str = "off") -> Estimate:
    options = replace(FIELD, rotation=rotation)
    return estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))


def test_a_wide_rise_at_the_edge_is_no_lump_and_the_same_rise_inside_is_one():
    edge = look(bump_map(noise=noise(1), half_mm=40.0, amplitude=0.3, x=36.0, y=0.0, sigma_x=10.0, sigma_y=10.0))
    inside = look(bump_map(noise=noise(1), half_mm=40.0, amplitude=0.3, x=0.0, y=0.0, sigma_x=10.0, sigma_y=10.0))
    assert edge.status == "no_estimate"
    assert inside.status == "estimate"


@pytest.mark.long
@pytest.mark.parametrize(("x", "status"), [(26.0, "no_estimate"), (20.0, "estimate")])
def test_a_wide_rise_must_be_seen_on_every_side(x: float, status: str) -> None:
    """The map ends 1.4 and 2 widths from its centre: 1.6 are asked for."""
    found = look(bump_map(noise=noise(3), half_mm=40.0, amplitude=0.3, x=x, y=0.0, sigma_x=10.0, sigma_y=10.0))
    assert found.status == status, found.reason


def test_a_lower_lump_is_found_behind_a_rise_at_the_edge():
    both = bump_values(half_mm=40.0, amplitude=0.5, x=36.0, y=0.0, sigma_x=10.0, sigma_y=10.0)
    both += bump_values(half_mm=40.0, amplitude=0.3, x=-12.0, y=3.0, sigma_x=4.0, sigma_y=4.0) - 1.0
    found = look(grid_map(both + noise(2)))
    assert found.status == "estimate"
    assert found.map_posterior is not None
    assert np.median(found.map_posterior.x_mm) == pytest.approx(-12.0, abs=1.0)
    assert np.median(found.map_posterior.sigma_x_mm) == pytest.approx(4.0, rel=0.15)
    assert any("rim" in candidate.fault or "flank" in candidate.fault for candidate in found.candidates)


def test_the_search_goes_on_past_a_rise_without_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    lump = (-12.0, 3.0)

    def only_the_lower(tactile_map: TactileMap, fit: BumpFit, _: SamplerSettings) -> WhiteAssessment:
        is_lump = fit.centre_mm == pytest.approx(lump, abs=1.0)
        return WhiteAssessment(tactile_map, fit, Detection(9.0 if is_lump else -1.0))

    monkeypatch.setattr(estimate, "assess", only_the_lower)
    both = bump_values(half_mm=25.0, amplitude=0.3, x=12.0, y=3.0, sigma_x=4.0, sigma_y=4.0)
    both += bump_values(half_mm=25.0, amplitude=0.2, x=lump[0], y=lump[1], sigma_x=4.0, sigma_y=4.0) - 1.0
    candidates, found = estimate.search(grid_map(both + noise(2, 51)), SamplerSettings(rotation="off"))
    assert found is not None
    assert found.fit.centre_mm == pytest.approx(lump, abs=1.0)
    assert [one.fault for one in candidates] == [NO_EVIDENCE, ""]


def test_the_search_ends_after_three_rises_without_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each further test may give a false lump."""
    places = [(x, y) for x in (-15.0, 0.0, 15.0) for y in (-12.0, 12.0)]
    values = 1.0 + sum(
        bump_values(half_mm=25.0, amplitude=0.3, x=x, y=y, sigma_x=3.0, sigma_y=3.0, level=0.0) for x, y in places
    )
    weighed = []

    def no_lump(tactile_map: TactileMap, fit: BumpFit, _: SamplerSettings) -> WhiteAssessment:
        weighed.append(fit.centre_mm)
        return WhiteAssessment(tactile_map, fit, Detection(-1.0))

    monkeypatch.setattr(estimate, "assess", no_lump)
    candidates, found = estimate.search(grid_map(values + noise(3, 51)), SamplerSettings(rotation="off"))
    assert len(weighed) == 3
    assert len(candidates) < len(places)
    assert found is not None
    assert found.fit.centre_mm == weighed[0]


@pytest.mark.parametrize(
    ("place", "normalise", "cut"),
    [((30.0, -5.0), "gain", True), ((0.0, -5.0), "gain", False), ((30.0, -5.0), "none", False)],
    ids=["at the rim", "inside", "level unknown"],
)
def test_a_high_rise_at_the_rim_needs_no_bump_that_fits_it(
    place: tuple[float, float], normalise: str, cut: bool
) -> None:
    """On a map that is wider than it is high, so that rows and columns are told apart."""
    made = bump_values(half_mm=30.0, amplitude=0.8, x=place[0], y=place[1], sigma_x=6.0, sigma_y=6.0)[15:-15]
    whole = grid_map(made + noise(7, 61)[15:-15], normalise=normalise, background=1.0 if normalise == "gain" else None)
    reason = cut_by_rim(whole, [Candidate(place, None, "a fit that ended elsewhere")])
    assert (reason is not None) == cut
    if reason is not None:
        assert reason.code == "window"
        assert reason.reason == "the map's rim cuts the rise near (30.0, -5.0) mm"
        assert reason.advice == "extend the strokes beyond it"


def test_no_place_is_weighed_twice_for_an_empty_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hills 6 mm wide that are no lump: seven weighings, two of them repeated, before a place kept its own."""
    hills = gaussian_filter(np.random.default_rng(5).standard_normal((81, 81)), 6.0, mode="wrap")
    weigh, places = estimate.assess, []

    def counted(tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> object:
        places.append(tuple(fit.theta[1:3]))
        return weigh(tactile_map, fit, options)

    monkeypatch.setattr(estimate, "assess", counted)
    found = look(grid_map(1.0 + 0.05 * hills / hills.std() + noise(104)))
    assert found.status == "no_estimate"
    assert len(places) == len(set(places)) == 4
    weighed = [one.detection.probability for one in found.candidates if one.detection is not None]
    assert found.detection is not None
    assert found.detection.probability in weighed
    assert found.weighed is not None
    assert found.weighed.detection is found.detection


def beside_a_rib(amplitude: float) -> TactileMap:
    axis = np.arange(81) - 40.0
    along = np.zeros((1, 81)) + axis[:, None] - 17.0
    lump = bump_values(half_mm=40.0, amplitude=amplitude, x=0.0, y=0.0, sigma_x=5.0, sigma_y=5.0)
    return grid_map(lump + 0.25 * np.exp(-0.5 * (along / 5.0) ** 2) + noise(3))


@pytest.mark.long
def test_a_lump_beside_a_rib_is_found_from_close_by(monkeypatch: pytest.MonkeyPatch) -> None:
    found = look(beside_a_rib(0.3), rotation="auto")
    assert found.status == "estimate"
    assert found.map_posterior is not None
    assert found.scene is not None
    assert [one.name for one in found.scene.structures if one.used and one.place] == ["rib"]
    for centre in (found.map_posterior.x_mm, found.map_posterior.y_mm):
        assert np.median(centre) == pytest.approx(0.0, abs=0.5)
    for width in (found.map_posterior.sigma_x_mm, found.map_posterior.sigma_y_mm):
        assert np.log(np.median(width) / 5.0) == pytest.approx(0.0, abs=3 * np.std(np.log(width)))
    assert look(beside_a_rib(0.0), rotation="auto").status == "no_estimate"
    # the control: from afar least squares grows over both
    monkeypatch.setattr(estimate, "_search_in_small_windows", lambda *_: None)
    assert look(beside_a_rib(0.3), rotation="auto").status == "no_estimate"


SIDES = {"pose_noise_x_mm": 0.0, "pose_noise_y_mm": 0.0, "frame_side_x_mm": 24.0, "frame_side_y_mm": 39.0}
SIDES |= {"frames_per_reading": 2.25}


def on_a_dome(normalise: str, quality: dict[str, float]) -> TactileMap:
    """A small lump on a wide rise, as of a stiff layer nearer to the skin."""
    dome = bump_values(half_mm=40.0, amplitude=0.2, x=0.0, y=0.0, sigma_x=30.0, sigma_y=30.0)
    lump = bump_values(half_mm=40.0, amplitude=0.15, x=3.0, y=-2.0, sigma_x=2.5, sigma_y=2.5, level=0.0)
    return replace(grid_map(dome + lump + 0.3 * noise(5), normalise=normalise), quality=quality)


@pytest.mark.long
def test_a_small_lump_on_a_wide_rise_is_found_on_the_levelled_map() -> None:
    found = look(on_a_dome("gain", SIDES))
    assert found.status == "estimate", found.reason
    assert found.map_posterior is not None
    assert np.median(found.map_posterior.sigma_x_mm) == pytest.approx(2.5, rel=0.1)
    assert np.median(found.map_posterior.amplitude) == pytest.approx(0.15, rel=0.1)
    # the control: where the array's size is not told, least squares grows over the dome
    assert look(on_a_dome("gain", {})).status == "no_estimate"


def test_levelling_is_what_dividing_by_the_mean_does_and_only_for_maps_that_lack_it() -> None:
    """Of a plain level nothing is taken; of a lump the mean over two arrays' overlap, which is a triangle."""
    flat = replace(bump_map(half_mm=40.0, amplitude=0.0), quality=SIDES)
    flat = replace(flat, recipe=replace(flat.recipe, normalise="gain"))
    np.testing.assert_allclose(levelled(flat).mean, 1.0)
    lump = on_a_dome("gain", SIDES)
    found = lump.mean - levelled(lump).mean
    x, y = np.meshgrid(lump.x_mm, lump.y_mm)
    for column, row in ((40, 40), (10, 55)):
        weight = np.clip(1 - np.abs(x - lump.x_mm[column]) / 24.0, 0, None)
        weight *= np.clip(1 - np.abs(y - lump.y_mm[row]) / 39.0, 0, None)
        assert found[row, column] == pytest.approx(float(np.average(lump.mean - 1.0, weights=weight)), rel=1e-6)
    for other in (on_a_dome("mean", SIDES), on_a_dome("gain", {})):
        assert levelled(other) is other
