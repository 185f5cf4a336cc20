"""`population` and the calibration learned from its table, as a user runs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from in_process import run_here

import tactile_bayes
from tactile_bayes.actions import simulation as population
from tactile_bayes.declarations import replace
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.tables import read_table
from tactile_bayes.forward.scene import Head
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.studies.population import BodyPrior, ExamRow, Population, head_columns

PHANTOMS = Path(tactile_bayes.__file__).parent / "demo" / "phantoms.csv"


def row(body: int, exam: int, *, seed: int = 0) -> ExamRow:
    """A row whose size follows the map exactly: ln d = 2.6 + 0.3 ln a + ln sigma - 1.4."""
    rng = np.random.default_rng([seed, body])
    log_a, log_s, seat = rng.normal(-1, 0.8), rng.normal(1.4, 0.4), rng.uniform(0, 1.2)
    d = float(np.exp(2.6 + 0.3 * log_a + log_s - 1.4 + rng.normal(0, 0.05)))
    wobble = float(np.random.default_rng([seed, body, exam]).normal(0, 0.01))
    shape = (float(np.exp(log_a)), float(np.exp(log_s + wobble)), float(np.exp(log_s + wobble)))
    made = ExamRow(body, exam, d, 1.0, 30.0, float(seat), 5.0, 10.0, 60.0, 9.5, True, *shape, 1e-4, 0, 0, 1e-4, 0, 1e-4)
    return replace(made, **head_columns(Head()))


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("population") / "population.csv"
    rows = [row(body, exam) for body in range(40) for exam in range(2)]
    unseen = replace(rows[0], body=40, detected=False, amplitude=None, sigma_x_mm=None, sigma_y_mm=None)
    path.write_text(population.population_csv([*rows, unseen]))
    return path


def test_a_mass_is_drawn_alike_wherever_it_is_drawn_and_others_differ() -> None:
    one, again, other = (Population(scans=2, seed=7).scenes(i) for i in (3, 3, 4))
    assert one == again
    assert one[0].solid_lumps[0].d_mm == one[1].solid_lumps[0].d_mm
    assert one[0].strokes != one[1].strokes
    assert one[0].solid_lumps[0].d_mm != other[0].solid_lumps[0].d_mm


def test_every_body_drawn_from_the_prior_is_a_valid_scene() -> None:
    """A scene refuses a lump through the skin or the wall: all of the prior must pass it."""
    prior = BodyPrior()
    for i in range(300):
        (scene,) = Population(scans=1, seed=99).scenes(i)
        lump = scene.solid_lumps[0]
        assert prior.d_mm[0] <= lump.d_mm <= prior.d_mm[1]


def test_centred_bodies_are_the_papers() -> None:
    drawn = Population(scans=1, seed=7, first_centred=3)
    assert [drawn.scenes(i)[0].solid_lumps[0].seat == 0.0 for i in (2, 3, 4)] == [False, True, True]


def test_the_table_has_the_columns_its_schema_names(table: Path) -> None:
    read = read_table(table, "population.table.json")
    assert len(read) == 81
    assert read.columns["detected"].count(False) == 1
    assert read.columns["amplitude"][-1] is None


def test_lumps_of_another_origin_widen_the_interval(table: Path, tmp_path: Path) -> None:
    words = ("calibrate", "size", table, "--against", table, "-o", "size.json")
    done = run_here(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "bodies of another origin: SD of ln d 0.0" in done.stdout
    found = read_size_calibration(tmp_path / "size.json")
    assert isinstance(found, BodyCalibration)
    assert (found.fit["other_masses"], found.spread.other_source) == (40.0, f"40 lumps of {table.name}")
    lumps = run_here("calibrate", "size", PHANTOMS, "--against", table, "-o", "l.json", cwd=tmp_path)
    assert "--against is for a table of `population`" in lumps.stderr


def test_eq6_is_learned_from_the_same_table(table: Path, tmp_path: Path) -> None:
    """The rows follow d = e^(1.2 + 0.3 ln a + ln sigma): f is -0.3 and m / e is e^1.2."""
    done = run_here("calibrate", "size", table, "--form", "eq6", "-o", "size.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "40 bodies, 80 maps" in done.stdout
    found = read_size_calibration(tmp_path / "size.json")
    assert isinstance(found, BodyCalibration)
    assert float(found.log_size(np.array(-1.0), np.array(1.4))) == pytest.approx(2.3, abs=0.04)
    constants = found.constants()
    assert constants["f"] == pytest.approx(-0.3, abs=0.05)
    assert constants["m"] / constants["e"] == pytest.approx(np.exp(1.2), rel=0.15)
    shown = run_here("show", "size.json", cwd=tmp_path)
    assert "population" in shown.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--fit-radius-mm", "10"], 2, "--fit-radius-mm is for tables of lumps"),
        (["--seed", "4"], 2, "--seed is for tables of lumps"),
    ],
)
def test_an_option_that_the_table_fixes_is_refused(table: Path, tmp_path: Path, arguments, code, words) -> None:
    done = run_here("calibrate", "size", table, "--form", "eq6", "-o", "x.json", *arguments, cwd=tmp_path)
    assert done.returncode == code
    assert words in done.stderr
    assert not (tmp_path / "x.json").exists()


def test_a_residual_needs_bodies_with_a_head_profile(table: Path, tmp_path: Path) -> None:
    done = run_here("calibrate", "size", table, "-o", "size.json", "--form", "eq6-residual", cwd=tmp_path)
    assert done.returncode == 3
    assert "fewer than 80 bodies have a lump and a head profile" in done.stderr
    assert not (tmp_path / "size.json").exists()


@pytest.mark.parametrize("way", ["gain", "mean", ""])
def test_a_calibration_keeps_how_its_maps_were_normalised(tmp_path: Path, way: str) -> None:
    rows = [replace(row(body, exam), normalise=way) for body in range(40) for exam in range(2)]
    (tmp_path / "t.csv").write_text(population.population_csv(rows))
    done = run_here("calibrate", "size", "t.csv", "--form", "eq6", "-o", "s.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert read_size_calibration(tmp_path / "s.json").recipe.normalise == (way or "mean")


def test_maps_normalised_in_several_ways_teach_nothing(tmp_path: Path) -> None:
    rows = [replace(row(body, exam), normalise=("mean", "gain")[exam]) for body in range(40) for exam in range(2)]
    (tmp_path / "t.csv").write_text(population.population_csv(rows))
    done = run_here("calibrate", "size", "t.csv", "--form", "eq6", "-o", "s.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "t.csv: its maps were normalised in several ways (gain, mean)" in done.stderr
    assert not (tmp_path / "s.json").exists()
    assert "--normalise gain" in done.stderr
    words = ("calibrate", "size", "t.csv", "--form", "eq6", "-o", "s.json", "--normalise")
    done = run_here(*words, "mean", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "40 bodies, 40 maps" in done.stdout
    assert read_size_calibration(tmp_path / "s.json").recipe.normalise == "mean"
    done = run_here(*words, "none", "--force", cwd=tmp_path)
    assert done.returncode == 3
    assert "none of its maps were made with --normalise none" in done.stderr


def test_a_table_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("d_mm,amplitude,sigma_x_mm\n10,0.3,4\n")
    done = run_here("calibrate", "size", "t.csv", "--form", "eq6", "-o", "x.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "t.csv" in done.stderr


def test_an_interrupted_run_goes_on_and_gives_the_same_table(tmp_path: Path, monkeypatch) -> None:
    """With the simulation stood in for by rows that come from the mass's number alone."""
    calls: list[int] = []

    def quick(population: Population, index: int) -> list[ExamRow]:
        calls.append(index)
        if index == 3 and calls.count(3) == 1:
            raise KeyboardInterrupt
        return [row(index, exam, seed=population.seed) for exam in range(population.scans)]

    monkeypatch.setattr(Population, "rows", quick)
    words = ("population", "--masses", 6, "-o", "p.csv")
    assert run_here(*words, cwd=tmp_path).returncode == 130
    assert not (tmp_path / "p.csv").exists()
    assert run_here(*words, cwd=tmp_path).returncode == 0
    assert calls == [0, 1, 2, 3, 3, 4, 5]
    first = (tmp_path / "p.csv").read_bytes()
    assert run_here(*words, "--force", cwd=tmp_path).returncode == 0
    assert calls[7:] == [0, 1, 2, 3, 4, 5]
    assert (tmp_path / "p.csv").read_bytes() == first


@pytest.mark.long
def test_a_scan_of_a_plain_lump_is_measured_as_a_patients() -> None:
    """With a cheap simulator in the solid model's place: bumps of the shape a lump of tissue might have."""
    from tactile_bayes.forward.scene import Lump
    from tactile_bayes.forward.simulate import simulate

    drawn = Population(scans=2, seed=7)

    def scan(scene):
        bumps = (Lump(x_mm=1.0, y_mm=-1.0, amplitude=0.5, sigma_x_mm=5.0, sigma_y_mm=4.0),)
        plain = replace(scene, body=None, solid_lumps=(), lumps=bumps)
        return simulate(plain, rng=np.random.default_rng(scene.seed)).scan

    rows = drawn.rows(2, scan)
    assert [r.exam for r in rows] == [0, 1]
    for found in rows:
        assert found.detected
        assert found.amplitude == pytest.approx(0.45, abs=0.1)
        assert found.sigma_x_mm == pytest.approx(4.6, rel=0.15)
        assert found.var_p is not None
        assert 0 < found.var_p < 0.05**2

    both = replace(drawn, normalise=("gain", "mean")).rows(2, scan)
    assert [(r.exam, r.normalise) for r in both] == [(0, "gain"), (0, "mean"), (1, "gain"), (1, "mean")]
    assert both[::2] == rows
    assert both[1].amplitude != both[0].amplitude

    def nothing(scene):
        return simulate(replace(scene, body=None, solid_lumps=()), rng=np.random.default_rng(scene.seed)).scan

    assert not any(r.detected for r in drawn.rows(2, nothing))
