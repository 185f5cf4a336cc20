"""Which mass of each map is pooled: the one that most maps show at one place in the patient."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from plain_reports import estimate_report
from posterior_maps import bump_values, correlated_field, grid_map
from searched_once import searched_once  # noqa: F401 - all tests of this file use it

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.reports import EstimateReport, MassReport, Place
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.report.pooled import maps_lying_apart, maps_of_another_mass

FAST = ("--method", "laplace")
CALIBRATION = "solid"


def document(*masses: tuple[float, float | None, bool], landmarks: bool = True, shift: float = 0.0) -> EstimateReport:
    """An estimate with masses at x in the patient, of a size and a hundredth of it high, reported or not.

    On the map they lie `shift` farther.
    """

    def mass(x: float, size: float | None, reported: bool) -> MassReport:
        found = height = None
        if size is not None:
            found = Quantity(median=size, mean=size, sd=1.0, low=size, high=size, probability=0.95, kind="eti")
            height = replace(found, median=size / 100.0)
        unknown = ("min_size_mm", "d_x_mm", "d_y_mm", "angle_deg", "another_exam")
        return MassReport(
            number=1,
            reported=reported,
            centre_mm=Place(x + shift, 0.0),
            centre_patient_mm=Place(x, 90.0) if landmarks else None,
            detected_probability=1.0,
            amplitude=height,
            max_size_mm=found,
            reason="",
            reason_code="",
            advice="",
            **dict.fromkeys(unknown),
        )

    return estimate_report(masses=tuple(mass(*one) for one in masses))


def test_a_map_that_reports_another_mass_is_told_the_place_of_the_common_one_on_it() -> None:
    """Two maps show one mass at 50 mm; the third reports one of 29 mm at 20, and has theirs as its second."""
    maps = [document((51.0, 6.0, True)), document((49.0, 6.5, True))]
    third = document((20.0, 29.0, True), (52.0, 7.0, False), shift=-50.0)
    assert maps_of_another_mass([*maps, third]) == {2: (2.0, 0.0)}
    assert maps_of_another_mass([third, *maps]) == {0: (2.0, 0.0)}
    # the control: where all report it nothing is done again
    assert maps_of_another_mass([*maps, document((20.0, 29.0, False), (52.0, 7.0, True))]) == {}


def test_of_two_masses_that_all_maps_show_the_one_that_most_report_is_pooled() -> None:
    """Not the larger: the ranking of each map alone decides, and noise in it does not mix the two."""
    maps = [
        document((10.0, 12.0, True), (45.0, 16.5, False)),
        document((11.0, 11.9, False), (44.0, 17.4, True)),
        document((9.0, 12.2, True), (45.0, 16.8, False)),
    ]
    assert maps_of_another_mass(maps) == {1: (11.0, 0.0)}


def test_without_landmarks_or_a_common_place_nothing_is_estimated_again() -> None:
    far = [document((10.0, 12.0, True)), document((50.0, 14.0, True))]
    assert maps_of_another_mass(far) == {}
    bare = document((20.0, 29.0, True), (52.0, 7.0, False), landmarks=False)
    assert maps_of_another_mass([document((51.0, 6.0, True)), bare]) == {}
    assert maps_lying_apart([document((51.0, 6.0, True)), bare]) is None
    assert maps_of_another_mass([document(), document((10.0, 12.0, True))]) == {}
    assert maps_lying_apart([document(), document((10.0, 12.0, True))]) is None


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_maps_whose_masses_lie_apart_are_reported(order: tuple[int, int]) -> None:
    """The lower one is named whatever the order; 14 mm between exams are landmarks touched anew."""
    far = [document((10.0, 12.0, True)), document((50.0, 14.0, True))]
    told = maps_lying_apart([far[i] for i in order])
    assert told == {order.index(0): "its mass lies 40 mm from that of the other maps and may be another one"}
    near = [document((10.0, 12.0, True)), document((24.0, 14.0, True))]
    assert maps_lying_apart(near) == {}


def of_breast(masses: Sequence[tuple[float, float, float]], *, seed: int, shift_mm: float) -> TactileMap:
    """A map with landmarks of bumps at x in the patient, with amplitude and width; its own x is `shift_mm` more."""
    rng = np.random.default_rng(seed)
    values = np.ones((71, 71))
    for x, amplitude, sigma in masses:
        one = bump_values(half_mm=35.0, x=x + shift_mm, y=2.0, sigma_x=sigma, sigma_y=sigma, amplitude=amplitude)
        values += one - 1.0
    values += 0.005 * correlated_field(rng, 71, length_cells=3.0) + 0.005 * rng.standard_normal(values.shape)
    patient = np.eye(4)
    patient[:2, 3] = (-shift_mm, 90.0)
    return replace(grid_map(values, normalise="gain"), patient_from_plane=patient)


@pytest.fixture(scope="module")
def exams(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three maps with one mass at x = 0 in the patient; the third has a higher one beside it, which it reports."""
    folder = tmp_path_factory.mktemp("breast")
    one = (0.0, 0.5, 3.5)
    maps = [
        of_breast([one], seed=1, shift_mm=0.0),
        of_breast([one], seed=2, shift_mm=2.0),
        of_breast([one, (-33.0, 0.8, 6.0)], seed=3, shift_mm=16.0),
    ]
    for i, tactile_map in enumerate(maps, start=1):
        write_map(folder / f"m{i}.nc", tactile_map, provenance=Provenance("test", {}, {}))
    return folder


@pytest.mark.long
def test_estimate_pool_sizes_one_mass(exams: Path) -> None:
    alone = json.loads(run_here("estimate", "m3.nc", "--json", *FAST, cwd=exams).stdout)
    assert [one["reported"] for one in alone["masses"]] == [True, False]
    largest = alone["max_size_mm"]["median"]
    pooled = json.loads(run_here("estimate", "m1.nc", "m2.nc", "m3.nc", "--pool", "--json", *FAST, cwd=exams).stdout)
    assert [one["mass"] for one in pooled["maps"]] == [[], [], [2, 2]]
    assert pooled["findings"] == []
    sizes = [one["max_size_mm"]["median"] for one in pooled["maps"]]
    assert max(sizes) < 1.15 * min(sizes)
    assert sizes[2] < 0.8 * largest
    text = run_here("estimate", "m1.nc", "m2.nc", "m3.nc", "--pool", "-v", *FAST, cwd=exams).stdout
    assert "(mass 2 of 2 on this map)" in text
    assert "check that every map was sized at the same mass" not in text
    # the control: a place that somebody gives is taken on every map
    given = ("--centre-mm", "-17", "2")
    done = run_here("estimate", "m3.nc", "m3.nc", *given, "--pool", "--json", *FAST, cwd=exams)
    assert done.returncode == 2  # one map twice
    kept = json.loads(run_here("estimate", "m3.nc", *given, "--json", *FAST, cwd=exams).stdout)
    assert kept["max_size_mm"]["median"] == pytest.approx(largest, rel=0.02)


@pytest.mark.long
def test_python_and_the_page_size_the_same_mass(exams: Path, tmp_path: Path) -> None:
    paths = [exams / f"m{i}.nc" for i in (1, 2, 3)]
    by_path = tb.pool(paths, method="laplace")
    assert [one["mass"] for one in by_path.document["maps"]] == [[], [], [2, 2]]
    assert by_path.maps[2].estimate.masses[1].reported
    own = [tb.estimate(path, method="laplace") for path in paths]
    assert tb.pool(own).max_size_mm.median == pytest.approx(by_path.max_size_mm.median, rel=1e-6)
    # an estimate of a place that was given stays what it is, and is told
    given = [*own[:2], tb.estimate(paths[2], method="laplace", centre_mm=(-17.0, 2.0))]
    told = [one.sentence() for one in tb.pool(given).findings]
    assert any(text.startswith("map 3: its mass lies 33 mm from that of the other maps") for text in told)
    page = tmp_path / "page.html"
    tb.exam_report(paths, page, method="laplace")
    text = page.read_text()
    assert "another rise stands at" not in text


@pytest.mark.long
def test_visits_are_compared_at_one_mass(exams: Path) -> None:
    """The later visit's report is about another mass; the control says which, and is refused."""
    compared = json.loads(run_here("compare", "m1.nc", "--with", "m3.nc", "--json", *FAST, cwd=exams).stdout)
    assert compared["status"] == "compared"
    assert tb.compare(exams / "m1.nc", exams / "m3.nc", method="laplace").document["status"] == "compared"
    given = tb.estimate(exams / "m3.nc", method="laplace", centre_mm=(-17.0, 2.0))
    refused = tb.compare(exams / "m1.nc", given, method="laplace").document
    assert refused["status"] == "not_one_mass"
    assert "33 mm apart" in refused["reason"]
