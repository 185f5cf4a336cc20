"""What `import tactile_bayes as tb` offers: lazily, with the command line's defaults and numbers."""

from __future__ import annotations

import copy
import inspect
import json
import pickle
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import click
import numpy as np
import pandas
import pytest
from emulated_devices import head_and_tracker, short_scan
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.cli import cli
from tactile_bayes.declarations import names_of, replace
from tactile_bayes.errors import BadDataError, DeviceError, UsageError
from tactile_bayes.files.documents import load_schema
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.options import MapOptions, TrialSettings
from tactile_bayes.presets import RESEARCH_USE

DEMO = Path(tb.__file__).parent / "demo"
FAST = {"method": "laplace"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the map of the packaged scan."""
    made = tmp_path_factory.mktemp("door")
    assert run_here("map", DEMO / "scan.mcap", "-o", "map.nc", cwd=made).returncode == 0
    return made


@pytest.fixture(scope="module")
def found(folder: Path) -> tb.SizeEstimate:
    return tb.estimate(folder / "map.nc", **FAST)


def test_the_import_alone_loads_nothing_heavy(run_python: Any) -> None:
    done = run_python("-c", "import sys, tactile_bayes as tb; print(*sys.modules)")
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert not loaded & {"numpy", "scipy", "pandas", "click", "matplotlib", "arviz", "typing"}
    assert not {name for name in loaded if name.startswith("tactile_bayes.")}


def test_every_name_is_there_and_typed() -> None:
    stub = (Path(tb.__file__).parent / "__init__.pyi").read_text()
    for name in tb.__all__:
        assert getattr(tb, name) is not None
        assert f" as {name}\n" in stub
    assert set(tb.__all__) <= set(dir(tb))
    with pytest.raises(AttributeError, match="no_such"):
        getattr(tb, "no_such")  # noqa: B009
    assert (Path(tb.__file__).parent / "py.typed").exists()


def defaults_of(command: str, *words: str) -> dict[str, Any]:
    found = cli.get_command(click.Context(cli), command)
    assert found is not None
    return found.make_context(command, list(words)).params


def test_the_defaults_are_the_command_lines() -> None:
    given = {name: one.default for name, one in inspect.signature(tb.estimate).parameters.items()}
    shown = defaults_of("estimate", "map.nc")
    shared = set(given) & set(shown)
    assert shared >= {"size_calibration", "method", "seed", "interval", "centre_mm", "scene", "accuracy_sd", "known"}
    assert {name: given[name] for name in shared} == {name: shown[name] for name in shared}
    from_file = set(load_schema("settings.schema.json")["properties"])
    assert set(given) - shared == {"tactile_map", "progress", *from_file}
    trial, shown = TrialSettings(), defaults_of("validate", "t.csv", "--excision", "e.csv")
    for name in ("intervals", "resamples", "seed", "error_ratio", "bayes"):
        assert getattr(trial, name) == shown[name]
    shown = defaults_of("map", "s.mcap", "-o", "m.nc")
    assert MapOptions(**{name: shown[name] for name in names_of(MapOptions)}) == MapOptions()


@pytest.mark.parametrize(
    ("function", "option", "meaning"),
    [
        (tb.build_map, "cell_mm", "Side of the square cells, mm."),
        (
            tb.estimate,
            "accuracy_mm",
            "Wanted Monte-Carlo error of interval ends, in mm; the finer of this and accuracy_sd",
        ),
        (tb.plan, "map_sd", "SD of ln size of single maps."),
        (tb.pool, "settings", "As of `estimate`"),
    ],
)
def test_the_help_of_a_function_says_what_each_option_is(function: Any, option: str, meaning: str) -> None:
    """It named them, and a record that no page of the reference has."""
    assert f"\n    {option}\n        {meaning}" in function.__doc__.replace("**", "")
    assert function.__doc__.count("\n    interval\n") == (function is tb.estimate)


def test_a_map_from_python_names_its_scans_as_the_command_lines_does(folder: Path, tmp_path: Path) -> None:
    built = tb.build_map(DEMO / "scan.mcap")
    built.save(tmp_path / "map.nc")
    assert built.scans
    assert tb.read_map(tmp_path / "map.nc").scans == tb.read_map(folder / "map.nc").scans == built.scans
    (of_file,) = built.scans
    assert tb.build_map(tb.demo_scan()).scans == ({name: told for name, told in of_file.items() if name != "sha256"},)


def test_either_way_gives_the_same_numbers(folder: Path, found: tb.SizeEstimate) -> None:
    told = json.loads(run_here("estimate", "map.nc", "--method", "laplace", "--json", cwd=folder).stdout)
    assert json.loads(json.dumps(found.answer.document)) == told
    direct = tb.estimate(tb.build_map(DEMO / "scan.mcap"), **FAST).answer.document
    assert {**direct, "provenance": None} == {**told, "provenance": None}
    assert found.max_size_mm is not None
    low, high = found.max_size_mm.interval()
    assert (low, high) == pytest.approx((told["max_size_mm"]["low"], told["max_size_mm"]["high"]), rel=1e-8)
    ninety = json.loads(
        run_here("estimate", "map.nc", "--method", "laplace", "--interval", 0.9, "--json", cwd=folder).stdout
    )
    assert found.max_size_mm.interval(0.9)[1] == pytest.approx(ninety["max_size_mm"]["high"], rel=1e-8)


@pytest.mark.long
def test_a_result_has_its_draws_in_every_form(found: tb.SizeEstimate, tmp_path: Path) -> None:
    size = found.max_size_mm
    assert size is not None
    frame = found.to_dataframe()
    assert len(frame) == size.values.size
    np.testing.assert_array_equal(frame.max_size_mm, np.asarray(size).ravel())
    np.testing.assert_array_equal(found.to_arviz().posterior["max_size_mm"], size.values)
    assert size.median == pytest.approx(frame.max_size_mm.median(), rel=2e-3)
    assert size.sd == pytest.approx(frame.max_size_mm.std(), rel=1e-2)
    found.save(tmp_path / "posterior.nc")
    with pytest.raises(UsageError, match="exists"):
        found.save(str(tmp_path / "posterior.nc"))
    for draw in (found.plot, found.plot_map):
        assert draw().axes
        draw(tmp_path / f"{draw.__name__}.svg")
        assert (tmp_path / f"{draw.__name__}.svg").stat().st_size > 1000
    with pytest.raises(UsageError, match="is 95; give a number above 0 and below 1"):
        size.interval(95)


def test_numpy_takes_draws_and_changes_none_of_the_estimates(found: tb.SizeEstimate) -> None:
    """`numpy.mean` called a property, and widths in cm by an array of one's own changed those that are saved."""
    draws = found.sigma_x_mm
    assert draws is not None
    assert float(np.mean(draws)) == pytest.approx(draws.mean)
    assert np.concatenate([draws, draws], axis=1).shape == (1, 2 * draws.values.size)
    for own in (np.array(draws), found.sigma_x_mm.values):  # type: ignore[union-attr]
        own /= 10.0
    assert repr(found.sigma_x_mm) == repr(draws)
    assert draws.median == pytest.approx(5.4, abs=0.1)


def test_a_noise_field_coarser_than_the_calibrations_is_a_caution(folder: Path, found: tb.SizeEstimate) -> None:
    """With 6 basis functions the lump of 14.3 mm had 10.7 mm without a word."""
    coarse = tb.estimate(folder / "map.nc", field_cosines=12, **FAST)
    assert (found.verdict, coarse.verdict) == ("sound", "doubtful")
    assert "resolved by 12 basis functions" in repr(coarse)


def test_a_repr_is_short_and_says_research(found: tb.SizeEstimate, folder: Path) -> None:
    for one in (found, tb.read_map(folder / "map.nc")):
        assert len(repr(one)) < 120
        assert RESEARCH_USE in one._repr_html_()
    assert "largest size" in repr(found)
    assert "<script>" not in replace(found, name="<script>")._repr_html_()


@pytest.mark.long
def test_no_lump_is_a_result(folder: Path) -> None:
    empty = tb.estimate(folder / "map.nc", centre_mm=(-25.0, 20.0), **FAST)
    assert (empty.status, empty.max_size_mm, empty.amplitude) == ("no_estimate", None, None)
    assert empty.why in repr(empty)
    assert len(empty.to_dataframe()) == 0
    widths = tb.estimate(folder / "map.nc", size_calibration="none", **FAST).to_dataframe()
    assert list(empty.to_dataframe().columns) == list(widths.columns)
    assert widths.max_size_mm.isna().all()
    assert widths.sigma_x_mm.notna().all()
    assert empty.plot().axes
    for act in (empty.to_arviz, lambda: empty.save("x.nc")):
        with pytest.raises(UsageError, match="there are no draws"):
            act()


def test_a_result_can_be_copied_pickled_and_made_in_a_thread(found: tb.SizeEstimate, folder: Path) -> None:
    made: list[tb.SizeEstimate] = []
    thread = threading.Thread(target=lambda: made.append(tb.estimate(folder / "map.nc", **FAST)))
    thread.start()
    thread.join()
    for one in (made[0], copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert repr(one) == repr(found)


def test_threads_may_save_at_once(tmp_path: Path) -> None:
    """The second was told that the file it named, another's, is open."""
    made = tb.map_of(np.random.default_rng(1).normal(1, 0.1, (60, 60)), spacing_mm=1, normalise="gain")
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as threads:
            list(threads.map(lambda number: made.save(tmp_path / f"{number}.nc"), range(4)))
    finally:
        sys.setswitchinterval(before)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    assert len(list(tmp_path.iterdir())) == 4


def test_maps_are_pooled_as_on_the_command_line(folder: Path) -> None:
    run_here("map", DEMO / "scan.mcap", "-o", "other.nc", "--pressure-window-kpa", 6, 14, cwd=folder)
    words = ("estimate", "map.nc", "other.nc", "--pool", "--method", "laplace", "--json")
    told = json.loads(run_here(*words, cwd=folder).stdout)
    pooled = tb.pool([folder / "other.nc", str(folder / "map.nc")], **FAST)
    assert pooled.document["max_size_mm"] == told["max_size_mm"]
    assert pooled.max_size_mm is not None
    assert pooled.plot().axes[0].get_title(loc="left") == "Size of the lump: phantom (2 maps pooled)"
    assert "largest size" in repr(pooled)


BAD: dict[str, tuple[Any, type[Exception], str]] = {
    "a path that is not there": (lambda f: tb.estimate(f / "no.nc"), BadDataError, "no.nc"),
    "a scan for a map": (lambda _: tb.read_map(DEMO / "scan.mcap"), BadDataError, "map"),
    "a map for a scan": (lambda f: tb.build_map(f / "map.nc"), BadDataError, "map.nc"),
    "an array": (lambda _: tb.estimate(np.zeros((3, 3))), UsageError, "a map is wanted, not ndarray"),
    "an unknown setting": (
        lambda f: tb.estimate(f / "map.nc", metod="laplace"),
        TypeError,
        "no keyword 'metod'; did you mean method",
    ),
    "settings that contradict": (
        lambda f: tb.estimate(f / "map.nc", noise="independent", scene="round", size_calibration="none"),
        UsageError,
        "needs correlated errors",
    ),
    "a map to pool": (lambda f: tb.pool(f / "map.nc"), UsageError, "give a list"),
    "no map to pool": (lambda _: tb.pool([]), UsageError, "no map to pool"),
    "a map twice": (lambda f: tb.pool([f / "map.nc"] * 2, **FAST), UsageError, "given twice"),
    "a table without a column": (
        lambda _: tb.validate(pandas.DataFrame({"patient": ["P1"]}), DEMO / "excision.csv"),
        BadDataError,
        r"trial \(DataFrame\).*mass",
    ),
    "a table with a wrong cell": (
        lambda _: tb.calibrate_size(pandas.DataFrame({"d_mm": [-1.0], "amplitude": [1.0], "sigma_x_mm": [3.0]})),
        BadDataError,
        r"table \(DataFrame\): line 2",
    ),
    "a form that is none": (
        lambda _: tb.calibrate_size(DEMO / "phantoms.csv", form="eq7"),
        UsageError,
        "did you mean eq6",
    ),
    "an option of no recording": (
        lambda f: tb.record(f / "s.mcap", head="/dev/nothing", duration_s=1, sid="left"),
        TypeError,
        "no keyword 'sid'; did you mean side",
    ),
    **{
        f"no such {name}": (
            lambda f, name=name, value=value: tb.estimate(f / "map.nc", **{name: value}),
            UsageError,
            f"{name} is .*; give ",
        )
        for name, value in {
            "method": "emcee",
            "scene": "turned",
            "noise": "white",
            "background": "none",
            "rotation": "yes",
            "interval": 95.0,
            "seed": -1,
        }.items()
    },
    "no head": (
        lambda f: tb.record(f / "s.mcap", head="/dev/nothing", duration_s=1, like=DEMO / "scan.mcap"),
        DeviceError,
        "cannot be opened",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_error(case: str, folder: Path) -> None:
    act, kind, words = BAD[case]
    before = sorted(folder.iterdir())
    with pytest.raises(kind, match=words) as caught:
        act(folder)
    assert "\n" not in str(caught.value)
    assert sorted(folder.iterdir()) == before


@pytest.mark.long
def test_tables_come_as_files_or_frames(tmp_path: Path) -> None:
    files = [DEMO / "trial.csv", DEMO / "excision.csv"]
    one, other = tb.validate(*files), tb.validate(*map(pandas.read_csv, files))
    assert {**one.document, "provenance": None} == {**other.document, "provenance": None}
    figures = one.to_dataframe().set_index(["modality", "figure"])
    error = figures.loc[("tactile", "mape_percent")]
    assert error.low < error.value < error.high
    assert "<TrialResult" in repr(one)
    done: list[tuple[int, int]] = []
    learned = tb.calibrate_size(
        pandas.read_csv(DEMO / "phantoms.csv"), path=tmp_path / "size.json", progress=lambda *one: done.append(one)
    )
    assert done[-1] == (800, 800)
    assert repr(learned).startswith("<SizeCalibration Eq 6 of lumps of 5 to 25 mm; normalise mean")
    assert (tmp_path / "size.json").stat().st_mode & 0o777 == 0o600
    by_mean = tb.build_map(DEMO / "scan.mcap", normalise="mean")
    given = tb.estimate(by_mean, size_calibration=learned, **FAST).answer.document
    by_path = tb.estimate(by_mean, size_calibration=tmp_path / "size.json", **FAST).answer.document
    assert given["max_size_mm"]["median"] == pytest.approx(by_path["max_size_mm"]["median"], rel=1e-6)


def test_simulate_keeps_the_truth(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text("[scene]\nduration_s = 1.0\nseed = 3\n[[lump]]\namplitude = 0.4\n")
    simulated = tb.simulate(tmp_path / "scene.toml")
    assert simulated.truth["lumps"]
    np.testing.assert_array_equal(
        tb.build_map([simulated]).tactile_map.mean, tb.build_map(simulated.scan).tactile_map.mean
    )


@pytest.mark.long
def test_a_script_records(tmp_path: Path) -> None:
    scan = short_scan()
    write_scan(tmp_path / "last.mcap", scan, provenance=Provenance("test", {}))
    with head_and_tracker(scan, speed=5.0) as words:
        ports = dict(zip(words[::2], words[1::2], strict=True))
        given = {name.removeprefix("--").replace("-", "_"): value for name, value in ports.items()}
        report = tb.record(tmp_path / "s.mcap", duration_s=0.5, like=tmp_path / "last.mcap", side="phantom", **given)
    assert report.frames >= 100
    assert tb.read_scan(tmp_path / "s.mcap").session["side"] == "phantom"


def test_scans_are_short_to_look_at() -> None:
    """A notebook printed all counts and times."""
    assert repr(tb.demo_scan()) == "<Scan 700 frames of 16 x 26 taxels, 840 poses, landmarks>"
    simulated = repr(tb.simulate(DEMO / "empty.toml", fidelity="empirical-gaussian"))
    assert simulated.startswith("<SimulatedScan of <Scan ")


def test_a_tilde_is_the_home_folder_on_either_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No shell expands it behind `--output=`; a name of nobody's home broke Python down."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    away = f"{tmp_path / 'nofolder'} is not a directory"
    assert away in run_here("simulate", DEMO / "scene.toml", "--output=~/nofolder/s.mcap", cwd=tmp_path).stderr
    with pytest.raises(UsageError, match="nofolder is not a directory"):
        tb.map_of(np.ones((30, 30)), spacing_mm=1, normalise="gain").save("~/nofolder/m.nc")
    with pytest.raises(BadDataError, match=r"^~nobody-12/m.nc: cannot be read"):
        tb.read_map("~nobody-12/m.nc")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: tb.build_map(np.ones((5, 16, 26))), "a scan is wanted, not ndarray; read one with read_scan"),
        (lambda: tb.build_map(None), "a scan is wanted, not NoneType"),
        (lambda: tb.read_scan(3), "a path is wanted, not int"),  # type: ignore[arg-type]
        (lambda: tb.simulate(3), "a path is wanted, not int"),  # type: ignore[arg-type]
        (lambda: tb.estimate([tb.demo_map()]), "a map is wanted, not list; give one map after the other, or pool"),
    ],
)
def test_a_wrong_argument_is_one_line(call: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        call()
