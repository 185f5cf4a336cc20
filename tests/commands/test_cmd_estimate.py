"""`estimate` as a user runs it."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from plain_calibration import RECIPE
from posterior_files import write_calibration, write_maps
from published_schemas import check_document
from settings_files import settings

from tactile_bayes.declarations import replace
from tactile_bayes.files.documents import load_schema

Run = Callable[..., "CompletedProcess[str]"]
FAST = ("--method", "laplace")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("estimate")
    write_maps(place)
    write_calibration(place / "size.json")
    write_calibration(place / "other.json", replace(RECIPE, normalise="gain", radius_mm=15.0))
    return place


@pytest.fixture(scope="module")
def alone(folder: Path) -> dict[str, str]:
    """What each map gives by itself, as JSON text."""
    return {
        name: run_here("estimate", f"{name}.nc", *FAST, "--size-calibration", "size.json", "--json", cwd=folder).stdout
        for name in ("a", "b", "empty")
    }


@pytest.fixture(scope="module")
def ensemble_run(run_cli: Run, folder: Path) -> CompletedProcess[str]:
    """One run of MCMC, with its draws."""
    words = ("a.nc", "--size-calibration", "size.json", "--method", "ensemble", "-v", "-o", "post.nc")
    return run_cli("estimate", *words, cwd=folder)


def test_json_has_every_documented_key_and_passes_its_schema(alone: dict[str, str]) -> None:
    schema = load_schema("estimate.schema.json")
    for text in alone.values():
        document = json.loads(text)
        assert set(schema["required"]) <= set(document)
        check_document(document, "estimate.schema.json")
    found = json.loads(alone["a"])
    assert found["status"] == "estimate"
    for name in ("max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm", "amplitude", "sigma_x_mm", "sigma_y_mm"):
        quantity = found[name]
        assert quantity["low"] < quantity["median"] < quantity["high"], name
        assert (quantity["probability"], quantity["kind"]) == (0.95, "eti")
    assert found["sigma_x_mm"]["median"] == pytest.approx(6.0, abs=0.3)
    assert {one["role"] for one in found["provenance"]["inputs"]} == {"map", "size_calibration"}
    assert "time" not in json.dumps(found["provenance"])


@pytest.mark.long
def test_a_document_out_of_order_would_not_pass(alone: dict[str, str]) -> None:
    document = json.loads(alone["a"])
    document["amplitude"].pop("kind")
    with pytest.raises(ValueError, match="amplitude"):
        check_document(document, "estimate.schema.json")


def test_text_tells_the_size_its_interval_and_what_was_left_out(ensemble_run: CompletedProcess[str]) -> None:
    assert ensemble_run.returncode == 0, ensemble_run.stderr
    for words in (
        "95 % interval (equal-tailed)",
        "largest size",
        "where 50 % of exams hold one.",
        "What makes the interval wide:",
        "Method ensemble: Monte-Carlo error of the interval ends: sizes",
        "; R-hat 1.0",
        "Left out: ",
        "Research use only",
    ):
        assert words in ensemble_run.stdout
    assert re.fullmatch(r"estimate: [0-9.]+ s\n", ensemble_run.stderr)


@pytest.mark.long
def test_the_draws_open_in_arviz(ensemble_run: CompletedProcess[str], folder: Path) -> None:
    assert ensemble_run.returncode == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    data = arviz.from_netcdf(str(folder / "post.nc"))
    posterior = data.posterior
    assert posterior.sizes["chain"] == 4
    assert posterior.sizes["draw"] >= 1000
    np.testing.assert_array_equal(
        posterior["max_size_mm"], np.maximum(posterior["d_x_mm"].values, posterior["d_y_mm"].values)
    )
    printed = next(line for line in ensemble_run.stdout.splitlines() if line.startswith("map width sigma_x"))
    median = float(np.median(posterior["sigma_x_mm"]))
    assert float(printed.split()[3]) == pytest.approx(median, abs=0.006)
    assert json.loads(posterior.attrs["provenance"])["seed"] == 1
    assert "created_at" not in data.attrs
    assert "created_at" not in posterior.attrs
    assert (folder / "post.nc").stat().st_mode & 0o777 == 0o600
    data.close()


def test_no_lump_is_an_answer_with_its_reason_and_exit_6(folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "p.nc"
    done = run_here("estimate", "empty.nc", *FAST, "--size-calibration", "size.json", "-o", output, cwd=folder)
    assert done.returncode == 6
    assert done.stdout.startswith("No lump found on the 26 cm2 that the map covers: ")
    assert "Research use only" in done.stdout
    assert not output.exists()


def kill_worker_of_b(path: Path, *, settings: Any) -> Any:
    """`answer_file` in a worker that is killed whenever it has b.nc."""
    import os
    import signal

    from tactile_bayes.api.estimating import answer_file

    if path.name == "b.nc":
        os.kill(os.getpid(), signal.SIGKILL)
    return answer_file(path, settings=settings)


@pytest.mark.long
def test_a_killed_worker_loses_no_other_map(folder: Path, alone: dict[str, str], monkeypatch: Any) -> None:
    from tactile_bayes.actions import estimate

    monkeypatch.setattr(estimate, "answer_file", kill_worker_of_b)
    words = ("b.nc", "empty.nc", "a.nc", *FAST, "--size-calibration", "size.json", "--json", "--workers", 2)
    done = run_here("estimate", *words, cwd=folder)
    assert done.returncode == 1
    assert json.loads(done.stdout) == [json.loads(alone[name]) for name in ("empty", "a")]
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: b.nc: its process ended twice without an answer")


@pytest.mark.long
def test_ctrl_c_prints_the_maps_that_are_done(folder: Path, alone: dict[str, str], monkeypatch: Any) -> None:
    from tactile_bayes.actions import estimate

    def interrupted(path: Path, *, settings: Any) -> Any:
        if path.name == "b.nc":
            raise KeyboardInterrupt
        return answer_file(path, settings=settings)

    answer_file = estimate.answer_file
    monkeypatch.setattr(estimate, "answer_file", interrupted)
    words = ("a.nc", "b.nc", "empty.nc", *FAST, "--size-calibration", "size.json")
    done = run_here("estimate", *words, "--json", cwd=folder)
    assert done.returncode == 130
    assert json.loads(done.stdout) == [json.loads(alone["a"])]
    assert "interrupted: 1 of 3 done" in done.stderr
    text = run_here("estimate", *words, cwd=folder)
    assert text.stdout.startswith("a.nc\n")
    assert "b.nc" not in text.stdout


@pytest.mark.long
@pytest.mark.parametrize("option", ["--figure", "--map-figure"])
def test_without_an_estimate_the_figure_is_the_map_with_what_was_looked_at_and_why(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    from tactile_bayes.report import estimate_figures

    drawn: list[dict[str, Any]] = []
    whole = estimate_figures.map_figure
    monkeypatch.setattr(
        estimate_figures, "map_figure", lambda *given, **more: drawn.append(more) or whole(*given, **more)
    )
    done = run_here("estimate", "empty.nc", *FAST, "-v", option, tmp_path / "f.svg", cwd=folder)
    assert done.returncode == 6
    assert (tmp_path / "f.svg").read_bytes().startswith(b"<?xml")
    (how,) = drawn
    assert how["note"] == done.stdout.splitlines()[0]
    assert how["title"] == "Tactile map: empty"
    assert ("Passed over near" in done.stdout) == any(one.fault for one in how["report"].candidates)


@pytest.mark.long
def test_the_scan_without_a_mass_gives_no_estimate(run_cli: Run, shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "scans" / "s08_no_mass.npz"
    assert run_cli("import", source, "-o", "s.mcap", cwd=tmp_path).returncode == 0
    assert run_cli("map", "s.mcap", "-o", "m.nc", cwd=tmp_path).returncode == 0
    done = run_cli("estimate", "m.nc", *FAST, "--json", "--map-figure", "m.png", cwd=tmp_path)
    assert done.returncode == 6
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")
    document = json.loads(done.stdout)
    assert document["status"] == "no_estimate"
    assert document["reason"]
    assert document["max_size_mm"] is None


@pytest.mark.long
def test_several_maps_keep_their_order_and_answers(run_cli: Run, folder: Path, alone: dict[str, str]) -> None:
    names = ("b", "empty", "a")
    options = (*FAST, "--size-calibration", "size.json", "--json")
    one = run_cli("estimate", *(f"{n}.nc" for n in names), *options, cwd=folder)
    two = run_cli("estimate", *(f"{n}.nc" for n in names), *options, "--workers", 2, cwd=folder)
    assert json.loads(one.stdout) == [json.loads(alone[name]) for name in names]
    assert one.returncode == two.returncode == 6
    assert one.stdout == two.stdout


@pytest.mark.long
def test_a_broken_map_is_named_and_the_rest_kept(folder: Path, alone: dict[str, str]) -> None:
    options = (*FAST, "--size-calibration", "size.json", "--json")
    done = run_here("estimate", "a.nc", "broken.nc", "b.nc", *options, cwd=folder)
    assert done.returncode == 3
    assert done.stderr.startswith("error: broken.nc: ")
    assert done.stderr.count("\n") == 1
    assert json.loads(done.stdout) == [json.loads(alone["a"]), json.loads(alone["b"])]


@pytest.mark.long
def test_the_narrower_interval_lies_within_the_wider(folder: Path, alone: dict[str, str]) -> None:
    options = (*FAST, "--size-calibration", "size.json", "--json", "--interval", 0.5)
    half: dict[str, Any] = json.loads(run_here("estimate", "a.nc", *options, cwd=folder).stdout)
    wide: dict[str, Any] = json.loads(alone["a"])
    for name in ("max_size_mm", "amplitude", "sigma_y_mm"):
        assert half[name]["probability"] == 0.5
        assert wide[name]["low"] < half[name]["low"] < half[name]["high"] < wide[name]["high"]
        assert half[name]["median"] == wide[name]["median"]


@pytest.mark.long
def test_another_recipe_is_refused_with_the_difference(folder: Path) -> None:
    done = run_here("estimate", "a.nc", *FAST, "--size-calibration", "other.json", cwd=folder)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.count("\n") == 1
    assert "a.nc" in done.stderr
    assert "normalise mean (the calibration: gain)" in done.stderr
    # the radius was not given, so it is the calibration's and does not differ
    assert "fit radius" not in done.stderr


@pytest.mark.long
def test_not_converged_is_exit_5_with_advice(folder: Path) -> None:
    done = run_here("estimate", "a.nc", "--method", "ensemble", *settings(folder, max_steps=150), cwd=folder)
    assert (done.returncode, done.stdout) == (5, "")
    assert done.stderr.count("\n") == 1
    assert "max_steps = " in done.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["none.nc"], 3, "none.nc"),
        (["size.json"], 3, "size.json"),
        (["a.nc", "--size-calibration", "none.json"], 3, "none.json"),
        (["a.nc", "--size-calibration", "a.nc"], 3, "a.nc"),
        (["a.nc", "b.nc", "-o", "p.nc"], 2, "one map at a time"),
        (["a.nc", "b.nc", "a.nc"], 2, "a.nc is given twice"),
        (["a.nc", "-o", "a.nc", "--force"], 2, "is an input"),
        (["a.nc", "-o", "x", "--figure", "x"], 2, "two outputs of this command"),
        (["none.nc", "--figure", "f.jpg"], 2, "f.jpg has the suffix '.jpg'; a figure is written as one of .png, .pdf"),
        (["none.nc", "--map-figure", "f"], 2, "does not say which kind of figure it is; name it f.png"),
        (["a.nc", "-o", "no/p.nc"], 2, "not a directory"),
        (["a.nc", "--interval", "1"], 2, "--interval"),
        (["a.nc", "--figure", "f.png", "--size-calibration", "none"], 2, "--size-calibration"),
        ([], 2, "MAP.nc"),
    ],
)
def test_mistakes_end_in_their_code_and_leave_nothing(
    folder: Path, arguments: list[str], code: int, words: str
) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    done = run_here("estimate", *arguments, *FAST, cwd=folder)
    assert (done.returncode, done.stdout) == (code, "")
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.long
@pytest.mark.parametrize("option", ["-o", "--figure", "--map-figure"])
def test_existing_outputs_are_left_alone_without_force(folder: Path, tmp_path: Path, option: str) -> None:
    output = tmp_path / ("mine.nc" if option == "-o" else "mine.png")
    output.write_text("mine")
    done = run_here("estimate", "a.nc", *FAST, "--size-calibration", "size.json", option, output, cwd=folder)
    assert done.returncode == 2
    assert "--force" in done.stderr
    assert output.read_text() == "mine"


def test_a_camera_image_can_be_estimated(shared_data: Path, tmp_path: Path) -> None:
    """The way for a picture: import it as a map, fit a free background within a radius that holds the beam."""
    picture = shared_data / "laserbeam" / "laserbeam_astigmatic.tif"
    made = run_here("import", picture, "--as", "map", "--spacing-mm", 0.1, "-o", "beam.nc", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    options = settings(tmp_path, background="free", fit_radius_mm=10, rotation="on")
    done = run_here("estimate", "beam.nc", *FAST, *options, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["sigma_x_mm"]["median"] == pytest.approx(3.30, abs=0.05)
    assert found["sigma_y_mm"]["median"] == pytest.approx(2.62, abs=0.05)
    assert found["angle_deg"]["median"] == pytest.approx(9.1, abs=2.0)


def field(folder: Path, *words: object, **more: object) -> CompletedProcess[str]:
    """`estimate a.nc` under correlated errors, without a calibration."""
    given = settings(folder, noise="field", background="free", field_cosines=8, **more)
    return run_here("estimate", "a.nc", *given, "--size-calibration", "none", *words, cwd=folder)


@pytest.mark.long
def test_the_scene_is_told_and_can_be_given(folder: Path) -> None:
    told = json.loads(field(folder, "--json").stdout)
    assert told["scene"]["supported"] in ("round", "ellipse")
    assert {one["name"] for one in told["scene"]["structures"]} >= {"ellipse", "rotated", "tilt", "second lump", "rib"}
    given = json.loads(field(folder, "--json", "--scene", "round").stdout)
    assert given["scene"]["shape"] == "round"
    assert given["sigma_x_mm"]["median"] == given["sigma_y_mm"]["median"]
    assert "Scene in the fit window of 20 mm about the lump: " in field(folder, "-v").stdout
    none = field(folder, "--scene", "none")
    assert none.returncode == 6
    assert none.stdout.startswith("No estimate: no lump was assumed")


@pytest.mark.parametrize("method", ["importance", "ensemble"])
def test_a_neighbour_asked_for_that_is_not_there_is_the_reason(folder: Path, method: str) -> None:
    asked = field(folder, "--scene", "rib", "--method", method)
    assert asked.returncode == 6
    assert asked.stdout.startswith(
        "No estimate: no rib found beside the bump.\nWhat would help: leave out --scene rib.\n"
    )


@pytest.mark.long
def test_priors_come_from_a_file_and_are_printed(folder: Path) -> None:
    assert "log-normal about 3.5 mm" in field(folder, "-v", width_median_mm=3.5).stdout
    document = json.loads(field(folder, "--json", width_median_mm=3.5).stdout)
    assert document["prior"]["width_median_mm"] == 3.5
    assert {one["role"] for one in document["provenance"]["inputs"]} == {"map", "settings"}
    assert document["prior_sensitivity"]["width_prior_times"] == 2.0
    wrong = field(folder, width=3.5)
    assert (wrong.returncode, wrong.stderr.count("\n")) == (3, 1)
    assert "width is not known" in wrong.stderr


@pytest.mark.long
def test_a_checkpoint_goes_on_where_it_stopped(folder: Path) -> None:
    words = ("--method", "ensemble", "--accuracy-sd", 0.1, "--json")
    stopped = field(folder, *words, checkpoint="chain.npz", max_steps=150)
    assert stopped.returncode == 5
    resumed, whole = field(folder, *words, checkpoint="chain.npz"), field(folder, *words)
    assert resumed.returncode == 0, resumed.stderr
    found = [json.loads(one.stdout)["sigma_x_mm"] for one in (resumed, whole)]
    assert found[0] == found[1]
    other = field(folder, *words, "--seed", 2, checkpoint="chain.npz")
    assert other.returncode == 3
    assert "another map, calibration or setting" in other.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "keys", "message"),
    [
        (["a.nc", "--scene", "round"], {"noise": "independent"}, "needs correlated errors"),
        (["a.nc", "b.nc"], {"checkpoint": "c.npz"}, "a checkpoint is of one map"),
        (["a.nc"], {"noise": "field", "background": "free", "checkpoint": "c.npz"}, "give --method ensemble"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    folder: Path, words: list[str], keys: dict[str, str], message: str
) -> None:
    done = run_here("estimate", *words, *settings(folder, **keys), "--size-calibration", "none", cwd=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--centre-mm", 300, 2), "off the map, which has x from"),
        (("--centre-mm", "nan", 2), "is not a number"),
        (("--interval", "nan"), "is not a number"),
        (("--known", "depth_mm", "inf"), "is not a number"),
        (("--known", "seat", 0, "--known", "seat", 1), "seat is known twice; give it one value"),
    ],
)
def test_a_place_or_a_range_that_makes_no_sense_is_a_usage_error(
    folder: Path, words: tuple[object, ...], message: str
) -> None:
    done = run_here("estimate", "a.nc", *FAST, "--size-calibration", "none", *words, cwd=folder)
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr


@pytest.mark.long
def test_a_map_of_far_too_many_cells_is_told_before_the_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("estimate", "a.nc", *FAST, "--size-calibration", "size.json", "--json")
    plain = run_here(*words, cwd=folder)
    assert plain.stderr == ""
    monkeypatch.setattr("tactile_bayes.mapping.map.MANY_CELLS", 500)
    told = run_here(*words, cwd=folder)
    assert told.stderr.startswith("a.nc: about ")
    assert told.stderr.count("\n") == 1
    assert (told.returncode, told.stdout) == (plain.returncode, plain.stdout)
