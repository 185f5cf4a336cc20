"""Wrong arguments of every Python function are refused in one line of Python's words, and results print in short."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

import tactile_bayes as tb
from tactile_bayes.api.arguments import options_as_keywords
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError

DEMO = Path(tb.__file__).parent / "demo"
FAST = {"method": "laplace"}


@pytest.fixture(scope="module")
def made() -> tb.Map:
    return tb.demo_map()


@pytest.fixture(scope="module")
def found(made: tb.Map) -> tb.SizeEstimate:
    return tb.estimate(made, **FAST)


TRIAL = pandas.DataFrame(
    {
        "patient": list("abcde"),
        "mass": "1",
        "modality": "tactile",
        "replicate": 1,
        "size_mm": range(10, 15),
        "status": "detected",
    }
)
EXCISION = pandas.DataFrame({"patient": list("abcde"), "mass": "1", "ex_vivo_mm": [11, 12, 14, 13, 15]})

SETTINGS: dict[str, tuple[Any, str]] = {
    "known of words": ({"known": {"seat": "centred"}}, "known seat is 'centred'; give a number"),
    "known below zero": ({"known": {"seat": -1}}, "known seat is -1; give a number from 0 on"),
    "known nothing of": ({"known": {"sea": 1.0}}, "no property sea; did you mean seat"),
    "known NaN": ({"known": {"seat": float("nan")}}, "known seat is nan"),
    "known a text": ({"known": "seat 1"}, "known is 'seat 1'; give a mapping"),
    "known a number": ({"known": 3}, "known is 3; give a mapping"),
    "an interval in percent": ({"interval": 95}, "interval is 95; give a number above 0 and below 1"),
    "an interval as text": ({"interval": "0.95"}, "interval is '0.95'"),
    "a seed as text": ({"seed": "1"}, "seed is '1'; give a whole number from 0 on"),
    "a broken seed": ({"seed": 1.5}, "seed is 1.5"),
    "no seed": ({"seed": None}, "seed is None"),
    "true as a seed": ({"seed": True}, "seed is True"),
    "half a place": ({"centre_mm": (1,)}, "centre_mm is .1,.; give a list of 2"),
    "a place as text": ({"centre_mm": "0,0"}, "centre_mm is '0,0'"),
    "a place of NaN": ({"centre_mm": (float("nan"), 0)}, r"centre_mm\[0\] is nan"),
    "a place off the map": ({"centre_mm": (900.0, 0.0)}, "^centre_mm .900, 0. lies off the map"),
    "a radius of nothing": ({"fit_radius_mm": 0}, "fit_radius_mm is 0; give a number above 0"),
    "an accuracy below 0": ({"accuracy_sd": -1}, "accuracy_sd is -1; give a number from 0.001 to 0.5"),
    "a prior as text": ({"amplitude_sd": "2"}, "amplitude_sd is '2'; give a number above 0"),
    "cosines as text": ({"field_cosines": "8"}, "field_cosines is '8'; give a whole number from 6 to 40"),
    "a calibration that is none": ({"size_calibration": 3}, "a path is wanted, not int"),
    "a repeatability that is none": ({"repeatability": 3}, "a path is wanted, not int"),
    "an accuracy of least squares": ({"method": "laplace", "accuracy_sd": 0.01}, 'or give method="importance"$'),
    "cosines of white noise": (
        {"noise": "independent", "field_cosines": 8},
        'leave them out, or give noise = "field"$',
    ),
    "a checkpoint of no chain": ({"checkpoint": "c.npz"}, 'give method="ensemble"$'),
    "an accuracy of white noise": (
        {"method": "importance", "noise": "independent", "accuracy_mm": 0.1},
        'needs .*give noise = "field"$',
    ),
}


@pytest.mark.parametrize("case", SETTINGS)
def test_a_setting_that_cannot_be_one_is_refused_with_what_can(made: tb.Map, case: str) -> None:
    given, words = SETTINGS[case]
    with pytest.raises(UsageError, match=words) as caught:
        tb.estimate(made, **{**FAST, **given})
    assert "--" not in str(caught.value)


CALLS: dict[str, tuple[Callable[..., Any], str]] = {
    "a scan twice": (lambda _: tb.build_map([tb.demo_scan(), tb.demo_scan()]), "scan 2 is the recording of scan 1"),
    "a scan and its file": (lambda _: tb.build_map([DEMO / "scan.mcap", tb.demo_scan()]), "would count twice"),
    "a cell as text": (lambda _: tb.build_map(tb.demo_scan(), cell_mm="2"), "cell_mm is '2'; give a number"),
    "one end of a window": (
        lambda _: tb.build_map(tb.demo_scan(), pressure_window_kpa=5),
        "pressure_window_kpa is 5; give a list of 2",
    ),
    "a window of one pressure": (
        lambda _: tb.check(tb.demo_scan(), pressure_window_kpa=5),  # type: ignore[arg-type]
        "pressure_window_kpa is 5; give a list of 2",
    ),
    "frames as a number": (lambda _: tb.scan(3), r"frames is int; give \(n, rows, columns\) numbers, or a path"),
    "a head of no kind": (
        lambda _: tb.scan(np.ones((2, 3, 3)), head=3),
        "head is int; give a path, or that of another",
    ),
    "landmarks of a scan without": (
        lambda _: tb.scan(np.ones((2, 3, 3)), landmarks=replace(tb.demo_scan(), landmarks=None)),
        "the landmarks were not touched; give another scan, or a JSON file",
    ),
    "landmarks of no kind": (lambda _: tb.scan(np.ones((2, 3, 3)), landmarks=3), "landmarks is int; give a path, or"),
    "a correction as text": (
        lambda _: tb.scan(np.ones((2, 3, 3)), correct="transposed"),
        "correct is 'transposed'; give",
    ),  # type: ignore[arg-type]
    "a correction of no kind": (
        lambda _: tb.scan(np.ones((2, 3, 3)), correct=("mirror",)),
        "a correction is 'mirror'; give one of rows-reversed",
    ),
    "a property with two values": (
        lambda _: tb.estimate(tb.demo_map(), known={"seat": [1, 2]}),
        r"known seat is \[1, 2\]; give a number",
    ),
    "a repeat that is the same map": (
        lambda one: tb.exam_report([one, one], "x.html"),
        "a map is given twice; give each map once",
    ),
    "a path of no letters": (lambda one: one.save(""), "the path is empty; give the name of a file"),
    "a page without its path": (lambda one: one.report(None), "the path is None; give a path"),
    "an exam's page without its path": (lambda one: tb.exam_report(one, None), "the path is None"),  # type: ignore[arg-type]
    "no number of patients": (lambda _: tb.plan(patients=[]), "patients is empty; give at least one"),
    "an estimate to pool": (lambda one: tb.pool(one), "pool takes several maps; give a list"),
    "nothing to pool": (lambda _: tb.pool(None), "maps is None; give a list"),  # type: ignore[arg-type]
    "days as a number": (lambda one: tb.compare(one, one, days=3), "days is 3; give a list"),  # type: ignore[arg-type]
    "dates as a text": (lambda one: tb.compare(one, one, dates="2026-01-01"), "dates is '2026-01-01'; give a list"),
    "growth as a number": (lambda one: tb.compare(one, one, grown_by=0.2), "grown_by is 0.2"),  # type: ignore[arg-type]
    "growth in percent": (
        lambda one: tb.compare(one, one, grown_by=[20]),
        "grown_by 20 is 2000 %; give a share: 0.2 for 20 %",
    ),
    "a shift as text": (lambda one: tb.compare(one, one, registration_mm="5"), "registration_mm is '5'"),  # type: ignore[arg-type]
    "a title of no text": (lambda one: one.report("x.html", title=3), "title is 3; give a text"),
    "a day of no text": (lambda one: one.report("x.html", day=3), "'3' is no date"),
    "nothing to report": (lambda _: tb.exam_report(None, "x.html"), "files is None; give a list"),
    "a map as a table of sizes": (
        lambda _: tb.export(tb.demo_map(), "x.csv", to="csv"),
        "csv files hold sizes, and a map has none; give its estimate alone",
    ),
    "a map exported twice": (
        lambda _: tb.export([tb.demo_map(), tb.demo_map()], "x.nrrd", to="nrrd"),
        "item 2 holds what item 1 holds; give each once",
    ),
    "nothing to export": (lambda _: tb.export(None, "x.json", to="fhir"), "no file was given to export; give a map"),
    "an ID of no text": (lambda one: tb.export(one, "x.json", to="fhir", patient_id=3), "patient_id is 3"),  # type: ignore[arg-type]
    "an exam of no date": (lambda one: tb.export(one, "x", to="dicom"), "give study_date YYYY-MM-DD"),
    "a mapping for DataFrames": (
        lambda _: tb.validate(TRIAL, EXCISION, columns="map.toml"),
        "columns is for wide CSV files, not for DataFrames",
    ),
    "no trial": (lambda _: tb.validate(None, None), "trial is None; give a path"),  # type: ignore[arg-type]
    "resamples as text": (lambda _: tb.validate(TRIAL, EXCISION, resamples="500"), "resamples is '500'"),
    "an interval of no kind": (lambda _: tb.validate(TRIAL, EXCISION, intervals="exact"), "give one of corrected"),
    "an error ratio below 0": (lambda _: tb.validate(TRIAL, EXCISION, error_ratio=-1), "error_ratio is -1"),
    "no table": (lambda _: tb.calibrate_size(None), "table is None"),  # type: ignore[arg-type]
    "a fit of no kind": (lambda _: tb.calibrate_size("t.csv", fit="x"), "fit is 'x'; give one of joint, two-stage"),
    "no folder": (lambda _: tb.calibrate_repeatability(None), "folder is None"),  # type: ignore[arg-type]
    "no scene": (lambda _: tb.simulate(None), "scene is None"),  # type: ignore[arg-type]
    "a scene's seed as text": (lambda _: tb.simulate(DEMO / "scene.toml", seed="1"), "seed is '1'"),  # type: ignore[arg-type]
    "a duration as text": (lambda _: tb.record("x", head="y", duration_s="1"), "duration_s is '1'"),  # type: ignore[arg-type]
    "a broken step": (lambda _: tb.record("x", head="y", duration_s=1, every=1.5), "every is 1.5; give a whole number"),
    "a protocol of no kind": (
        lambda _: tb.record("x", head="y", duration_s=1, tracker_protocol="z"),
        "tracker_protocol is 'z'; give one of open, fastrak",
    ),
    "an interval of draws": (lambda one: one.max_size_mm.interval(95), "is 95; give a number above 0 and below 1"),
    "a file that exists": (lambda one: one.save(__file__), "give force=True"),
}


@pytest.mark.parametrize("case", CALLS)
def test_an_argument_that_cannot_be_one_is_refused_with_what_can(
    found: tb.SizeEstimate, case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    act, words = CALLS[case]
    with pytest.raises(UsageError, match=words) as caught:
        act(found)
    assert "--" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: tb.build_map(tb.demo_scan(), cel_mm=2), "cell_mm"),
        (lambda: tb.estimate(tb.demo_map(), calibration="eq6"), "size_calibration"),
        (lambda: tb.validate(TRIAL, EXCISION, resample=500), "resamples"),
        (lambda: tb.export(DEMO, "x", to="fhir", patientid="1"), "patient_id"),
        (lambda: tb.calibrate_size(TRIAL, normalize="mean"), "normalise"),
    ],
)
def test_a_keyword_that_is_none_is_answered_with_the_one_meant(call: Callable[[], object], name: str) -> None:
    with pytest.raises(TypeError, match=f"did you mean {name}"):
        call()


@pytest.mark.parametrize(
    ("told", "wanted"),
    [
        ("map again with --cell-mm 0.5 or press lightly", "map again with cell_mm=0.5 or press lightly"),
        ("x exists; choose another name or give --force", "x exists; choose another name or give force=True"),
        ("leave --head out, or choose another --fidelity", "leave head out, or choose another fidelity"),
        ("try --method ensemble", 'try method="ensemble"'),
        ("give their unit: --unit kPa", 'give their unit: unit="kPa"'),
        ("leave it or --unit out", "leave it or unit out"),
        ("or map it with --as-stated", "or map it with as_stated=True"),
        ("--frame-order rows takes them as they are", 'frame_order="rows" takes them as they are'),
        ("and give --size-calibration size.json.", 'and give size_calibration="size.json".'),
        ("its normalise is mean, not gain as --normalise says", "its normalise is mean, not gain as normalise says"),
        ("a larger max_steps in --settings FILE.toml", "a larger max_steps"),
        ("make it again: `tactile-bayes estimate m.nc --json`", "make it again: `tactile-bayes estimate m.nc --json`"),
    ],
)
def test_options_become_keywords_and_commands_stay(told: str, wanted: str) -> None:
    assert options_as_keywords(told) == wanted


def test_a_scan_that_lacks_something_is_told_its_own_keywords() -> None:
    frames = np.ones((2, 3, 3))
    lacking = tb.errors.BadDataError
    with pytest.raises(lacking, match=r"or give poses FILE, head HEAD.json, unit or calibration CAL"):
        tb.scan(frames)
    with pytest.raises(lacking, match=r"columns\.raet_hz is not known; did you mean rate_hz"):
        tb.scan(frames, columns={"raet_hz": 9})


def test_a_day_may_be_a_date(found: tb.SizeEstimate, tmp_path: Path) -> None:
    found.report(tmp_path / "day.html", day=date(2026, 3, 1))  # type: ignore[arg-type]
    found.report(tmp_path / "text.html", day="2026-03-01")
    assert (tmp_path / "day.html").read_bytes() == (tmp_path / "text.html").read_bytes()


@pytest.mark.long
def test_numbers_of_numpy_are_taken_as_numbers(made: tb.Map) -> None:
    of_numpy = tb.estimate(made, seed=np.int64(3), interval=np.float64(0.9), known={"seat": np.float32(1.0)}, **FAST)
    plain = tb.estimate(made, seed=3, interval=0.9, known={"seat": 1.0}, **FAST)
    assert of_numpy.answer.document == plain.answer.document
    scan, window = tb.demo_scan(), (np.float32(5.0), np.float64(14.0))
    by_window = [tb.build_map(scan, pressure_window_kpa=one).tactile_map for one in (window, np.array(window))]  # type: ignore[arg-type]
    assert {one.fingerprint for one in by_window} == {made.tactile_map.fingerprint}
    checks = tb.check(scan, pressure_window_kpa=window), tb.check(scan)  # type: ignore[arg-type]
    assert {repr(one) for one in checks} == {f"<ArrangementCheck {checks[0].words}>"}
    assert tb.estimate(made, centre_mm=np.zeros(2), **FAST).settings.centre_mm == (0.0, 0.0)


def _public(value: Any, depth: int = 5) -> Iterator[Any]:
    """What a notebook can reach from a result."""
    if depth and type(value).__module__.startswith("tactile_bayes"):
        yield value
        for name in dir(value):
            if not name.startswith("_") and not callable(getattr(type(value), name, None)):
                yield from _public(getattr(value, name, None), depth - 1)
    elif isinstance(value, tuple | list) and depth and value:
        yield from _public(value[0], depth - 1)


@pytest.mark.long
def test_nothing_that_a_result_leads_to_prints_an_array(found: tb.SizeEstimate, made: tb.Map) -> None:
    """An estimate's parts once printed 589 lines, a comparison's 914."""
    scan = tb.simulate(DEMO / "scene.toml", seed=2)
    later = tb.build_map(scan)
    several = tb.pool([found, later], **FAST), tb.compare(found, later, **FAST), tb.validate(TRIAL, EXCISION)
    seen: dict[int, Any] = {}
    for result in (found, scan, made, *several):
        seen |= {id(one): one for one in _public(result)}
    assert len(seen) > 60
    for one in seen.values():
        text = repr(one)
        assert len(text) < 800, type(one)
        assert "\n" not in text, type(one)
