"""`calibrate size --correct` as a user runs it: tables of bumps and of maps, the file, `show`, `estimate`, `--pool`."""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pandas
import pytest
from campaign_files import thinned, write
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.errors import UsageError
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.size.bodies import BodyCalibration

DEMO = Path(tb.__file__).parent / "demo"
RECIPE = {"normalise": "gain", "background": "free", "fit_radius_mm": 20, "noise": "field"}
PROFILE = ("head_profile_x2", "head_profile_y2", "head_profile_y4")
SHIFT = 0.2


def body_calibration(path: str | Path) -> BodyCalibration:
    found = read_size_calibration(Path(path))
    assert isinstance(found, BodyCalibration)
    return found


def solid() -> BodyCalibration:
    path = size_calibration_path("solid")
    assert path is not None
    return body_calibration(path)


@cache
def demo_profile() -> tuple[float, ...]:
    quality = tb.demo_map().tactile_map.quality
    return tuple(quality[name] for name in PROFILE)


def table(n: int = 12, *, profile: bool = True, **more: object) -> pandas.DataFrame:
    """Lumps whose sizes are e^0.2 times those that `solid` gives their maps, at the demo map's depth of fat."""
    rng, told = np.random.default_rng(102), demo_profile()
    use = solid().at_fat([told if profile else None])
    width, amplitude = np.linspace(np.log(3.2), np.log(6.5), n), np.exp(rng.uniform(-1.4, -0.8, n))
    d_mm = np.exp(use.log_size(np.log(amplitude), width) + SHIFT)
    columns = {"d_mm": d_mm, "amplitude": amplitude, "sigma_x_mm": np.exp(width), "sigma_y_mm": np.exp(width)}
    if profile:
        columns |= dict(zip(PROFILE, told, strict=True))
    return pandas.DataFrame({**columns, **RECIPE, **more})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's map, phantoms with and without the head's profile, and the corrections by them."""
    place = tmp_path_factory.mktemp("correct")
    assert run_here("map", DEMO / "scan.mcap", "-o", "demo.nc", cwd=place).returncode == 0
    for name, profile in (("phantoms", True), ("plain", False)):
        table(profile=profile).to_csv(place / f"{name}.csv", index=False)
        done = run_here("calibrate", "size", f"{name}.csv", "--correct", "solid", "-o", f"{name}.json", cwd=place)
        assert done.returncode == 0, done.stderr
        (place / f"{name}.txt").write_text(done.stdout)
    return place


@pytest.mark.long
def test_the_report_tells_the_shift_and_what_is_odd(folder: Path) -> None:
    told = (folder / "phantoms.txt").read_text()
    assert "solid, corrected by 12 phantoms of this site: +2" in told
    assert "12 phantoms; the depth of fat is used" in told
    assert told.startswith("CAUTION: 12 of 12 phantoms have no depth_ratio")
    assert "the depth of fat is not used" in (folder / "plain.txt").read_text()


@pytest.mark.long
def test_estimate_adds_the_shift_and_says_by_what(folder: Path) -> None:
    words = ("estimate", "demo.nc", "--method", "laplace", "--json", "--size-calibration")
    plain = tb.estimate(folder / "demo.nc", method="laplace", size_calibration="solid").answer.document
    done = json.loads(run_here(*words, "phantoms.json", cwd=folder).stdout)
    site = body_calibration(folder / "phantoms.json").site
    assert site is not None
    sigma = [done[name]["median"] for name in ("sigma_x_mm", "sigma_y_mm")]
    expected = float(np.exp(site.log_shift(np.array(np.mean(np.log(sigma))))))
    assert done["max_size_mm"]["median"] / plain["max_size_mm"]["median"] == pytest.approx(expected, rel=0.01)
    assert 0.0 < done["variance_share"]["site"] < 60.0
    assert "site" not in plain["variance_share"]
    told = run_here(*words[:2], "--method", "laplace", "--size-calibration", "phantoms.json", cwd=folder).stdout
    assert "sizes by the calibration phantoms.json (solid, corrected by 12 phantoms of this site: +" in told


@pytest.mark.long
def test_phantoms_without_the_heads_profile_correct_sizes_without_depth_of_fat(folder: Path) -> None:
    words = ("estimate", "demo.nc", "--method", "laplace", "-v", "--size-calibration")
    told = run_here(*words, "plain.json", cwd=folder).stdout
    assert "the phantoms that correct the calibration have no pressure profile of the head" in told
    assert "fat under the head" not in told
    assert "fat under the head" in run_here(*words, "phantoms.json", cwd=folder).stdout


@pytest.mark.long
def test_maps_are_pooled_with_the_correction(folder: Path) -> None:
    words = ("estimate", "demo.nc", "--pool", "--method", "laplace", "--size-calibration")
    sizes = [
        json.loads(run_here(*words, name, "--json", cwd=folder).stdout)["max_size_mm"]["median"]
        for name in ("solid", "phantoms.json")
    ]
    assert sizes[1] / sizes[0] > 1.1
    for more in ((), ("-v",)):
        told = run_here(*words, "phantoms.json", *more, cwd=folder).stdout
        assert "izes by solid, corrected by 12 phantoms of this site" in told


@pytest.mark.long
def test_show_describes_the_correction_and_its_base(folder: Path) -> None:
    found = json.loads(run_here("show", "phantoms.json", "--json", cwd=folder).stdout)
    assert found["schema"] == "tactile-bayes/site-calibration/1"
    assert found["correction"]["phantoms"] == 12
    low, high = found["correction"]["percent_interval"]
    assert low < found["correction"]["percent"] < high
    assert found["base"]["form"] == "population"
    assert "correction" in run_here("show", "phantoms.json", cwd=folder).stdout


@pytest.mark.long
def test_python_gives_what_the_file_holds(folder: Path) -> None:
    given = tb.calibrate_size(table(), correct="solid")
    written = body_calibration(folder / "phantoms.json")
    assert isinstance(given, BodyCalibration)
    assert "corrected by 12 phantoms, lumps of 5 to 30 mm; normalise gain" in repr(given)
    assert given.site is not None and written.site is not None  # noqa: PT018
    assert written.site.mean == pytest.approx(given.site.mean, rel=1e-8)
    assert written.site.covariance == pytest.approx(given.site.covariance, rel=1e-7)
    one, two = (tb.estimate(folder / "demo.nc", size_calibration=c, method="laplace") for c in (given, written))
    assert one.max_size_mm is not None and two.max_size_mm is not None  # noqa: PT018
    assert one.max_size_mm.median == pytest.approx(two.max_size_mm.median, rel=1e-6)
    with pytest.raises(UsageError, match="form is for learning a calibration; leave it out"):
        tb.calibrate_size(table(), correct="solid", form="eq6-residual")


@pytest.mark.long
def test_map_files_are_estimated_and_keep_the_depth_of_fat(folder: Path) -> None:
    for i in range(3):
        write(folder / f"m{i}.mcap", thinned(i, 3))
        assert run_here("map", f"m{i}.mcap", "-o", f"m{i}.nc", cwd=folder).returncode == 0
    mapped = (folder / "m1.nc").read_bytes()
    rows = "".join(f"m{i}.nc,15,1.0,100,centred\n" for i in range(3))
    (folder / "maps.csv").write_text("file,d_mm,depth_ratio,stiffness_ratio,seat\n" + rows)
    words = ("calibrate", "size", "maps.csv", "--correct", "solid", "-o", "maps.json", "--force")
    done = run_here(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "3 phantoms; the depth of fat is used" in done.stdout
    assert "too alike in width" in done.stdout
    inputs = json.loads((folder / "maps.json").read_text())["provenance"]["inputs"]
    assert {"table", "size_calibration", "map_1", "map_2", "map_3"} <= {one["role"] for one in inputs}
    over = run_here(*words[:-2], "m1.nc", "--force", cwd=folder)
    assert over.returncode == 2
    assert (folder / "m1.nc").read_bytes() == mapped
    refused = run_here(*words, "--noise", "field", cwd=folder)
    assert refused.returncode == 2
    assert "map files state how they were made" in refused.stderr
    shutil.copyfile(folder / "m0.nc", folder / "copy.nc")
    (folder / "maps.csv").write_text("file,d_mm,phantom\nm0.nc,15,A\nm1.nc,15,B\nm2.nc,15,C\ncopy.nc,15,D\n")
    refused = run_here(*words, cwd=folder)  # a copied map would count as another lump
    assert "line 5, column file: is of the same scan as m0.nc; list each scan once" in refused.stderr
    # one lump mapped three times is one lump
    (folder / "maps.csv").write_text("file,d_mm,phantom\n" + "".join(f"m{i}.nc,15,A\n" for i in range(3)))
    refused = run_here(*words, cwd=folder)
    assert refused.returncode == 3
    assert "1 phantom in the range of solid; a correction needs at least 3 distinct phantoms" in refused.stderr


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"normalise": "mean"}, 3, "normalise mean (the calibration: gain)"),
        ({"noise": "independent"}, 3, "noise independent (the calibration: field)"),
        (
            {"head_radius_mm": 30.0},
            3,
            "head_radius_mm: is 30, and the calibration is for a head with a radius of 35 mm",
        ),
        ({"phantom": "A"}, 3, "but "),
        ({"sigma_y_mm": ""}, 3, "give both widths of the map"),
        ({"seat": "upstairs"}, 3, "give centred, resting or a number"),
        ({"sigma_x_mm": 40.0, "sigma_y_mm": 40.0}, 3, "0 phantoms in the range of solid"),
        ({"stiffness_ratio": 2.0}, 3, "its stiffness_ratio is 2, and the calibration's lumps have 8 and more"),
    ],
)
def test_tables_that_do_not_fit_are_refused_in_one_line(tmp_path: Path, change, code, words) -> None:
    table(4, profile=False, **change).to_csv(tmp_path / "t.csv", index=False)
    done = run_here("calibrate", "size", "t.csv", "--correct", "solid", "-o", "out.json", cwd=tmp_path)
    assert done.returncode == code, done.stdout
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_spreadsheets_list_of_maps_is_known_as_one(tmp_path: Path, separator: str) -> None:
    """By commas alone its header was one name, and the map files "not known here"."""
    (tmp_path / "maps.csv").write_text(f"file{separator}d_mm\nnone.nc{separator}19,9\n", encoding="utf-8-sig")
    done = run_here("calibrate", "size", "maps.csv", "--correct", "solid", "-o", "s.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "none.nc: cannot be read (No such file or directory)" in done.stderr


@pytest.mark.long
def test_a_correction_that_is_impossible_is_refused(folder: Path) -> None:
    words = ("calibrate", "size", "phantoms.csv", "-o", "never.json", "--correct")
    for name in ("plane-strain", "none"):
        done = run_here(*words, name, cwd=folder)
        assert (done.returncode, "cannot be corrected" in done.stderr) == (2, True)
    again = run_here(*words, "phantoms.json", cwd=folder)
    assert again.returncode == 3
    assert "corrected already" in again.stderr
    fit = run_here(*words, "solid", "--fit", "two-stage", cwd=folder)
    assert fit.returncode == 2
    assert "leave it out with --correct" in fit.stderr


@pytest.mark.long
def test_a_damaged_file_is_refused(folder: Path) -> None:
    document = json.loads((folder / "phantoms.json").read_text())
    document["site"]["covariance"] = [[1.0, 2.0], [2.0, 1.0]]
    (folder / "broken.json").write_text(json.dumps(document))
    done = run_here("show", "broken.json", cwd=folder)
    assert done.returncode == 3
    assert "learn it anew" in done.stderr
    document["base"] = json.loads((folder / "phantoms.json").read_text())
    (folder / "broken.json").write_text(json.dumps(document))
    assert run_here("show", "broken.json", cwd=folder).returncode == 3
