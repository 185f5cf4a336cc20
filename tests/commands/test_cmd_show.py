"""`show` on every kind of file, as text and as JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from in_process import run_here
from posterior_files import write_calibration, write_maps

import tactile_bayes
from tactile_bayes.actions.show import fact_lines

Run = Callable[..., "CompletedProcess[str]"]
DEMO = Path(tactile_bayes.__file__).parent / "demo"

# file: schema, kind, words of the text
KINDS = {
    "scan.mcap": ("tactile-bayes/scan/1", "scan", "frame_rate_hz"),
    "a.nc": ("tactile-bayes/map/2", "map", "covered_cells"),
    "post.nc": ("tactile-bayes/posterior/1", "posterior", "sigma_x_mm"),
    "size.json": ("tactile-bayes/size-calibration/1", "size calibration", "residual_correlation"),
    "one.json": ("tactile-bayes/estimate/1", "estimate", "detected_probability"),
    "many.json": ("tactile-bayes/estimate/1", "list", "length"),
    "report.json": ("tactile-bayes/validate/1", "validate", "provenance"),
    "trial.csv": (None, "table: trial", "rows"),
    "excision.csv": (None, "table: excision", "rows"),
    "failures.csv": ("tactile-bayes/failures/1", "table: failures", "step"),
    "none.csv": ("tactile-bayes/failures/1", "table: failures", "rows     0"),
    "phantoms.csv": ("tactile-bayes/size_table/1", "table: size table", "rows"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("show")
    write_maps(place)
    write_calibration(place / "size.json")
    for name in ("scan.mcap", "trial.csv", "excision.csv", "phantoms.csv"):
        shutil.copyfile(DEMO / name, place / name)
    row = "P1,1,1,1,a.mcap,map,it was cut off; copy it again"
    header = "patient,visit,mass,replicate,file,step,reason\n"
    (place / "failures.csv").write_text(f"{header}{row}\n")
    (place / "none.csv").write_text(header)
    fast = ("--method", "laplace", "--size-calibration", "size.json", "--json")
    one = run_here("estimate", "a.nc", *fast, "-o", "post.nc", cwd=place)
    many = run_here("estimate", "a.nc", "b.nc", *fast, cwd=place)
    (place / "one.json").write_text(one.stdout)
    (place / "many.json").write_text(many.stdout)
    report = run_here("validate", "trial.csv", "--excision", "excision.csv", "-o", "report.json", cwd=place)
    assert (one.returncode, many.returncode, report.returncode) == (0, 0, 0), report.stderr
    return place


@pytest.mark.parametrize("name", list(KINDS))
def test_every_kind_of_file_is_known(folder: Path, name: str) -> None:
    schema, kind, words = KINDS[name]
    text = run_here("show", name, cwd=folder)
    plain = run_here("show", name, "--json", cwd=folder)
    assert (text.returncode, plain.returncode) == (0, 0), text.stderr + plain.stderr
    assert words in text.stdout
    assert text.stdout.rstrip().endswith("Research use only: not a diagnostic device.")
    found = json.loads(plain.stdout)
    assert found["kind"] == kind
    if schema is not None:
        assert found["schema"] == schema
    assert text.stderr == plain.stderr == ""


def test_a_list_of_estimates_tells_the_verdict_and_the_findings_of_each(folder: Path) -> None:
    """As it does of one: a caution on the second map of two was shown as "length 2"."""
    documents = json.loads((folder / "many.json").read_text())
    told = json.loads(run_here("show", "many.json", "--json", cwd=folder).stdout)["of_each"]
    assert [one["verdict"] for one in told.values()] == [one["verdict"] for one in documents]
    (folder / "alone.json").write_text(json.dumps(documents[1]))
    alone = json.loads(run_here("show", "alone.json", "--json", cwd=folder).stdout)
    assert told["2"] == {"verdict": alone["verdict"], "findings": alone["findings"]}


def test_a_map_tells_its_shape_and_recipe(folder: Path) -> None:
    found = json.loads(run_here("show", "a.nc", "--json", cwd=folder).stdout)
    assert found["shape"] == {"ny": 51, "nx": 51}
    assert found["extent_mm"] == {"x": 51.0, "y": 51.0}
    assert found["covered_cells"] == 2601
    assert found["recipe"]["normalise"] == "mean"


def test_a_posterior_tells_its_method_draws_and_origin(folder: Path) -> None:
    found = json.loads(run_here("show", "post.nc", "--json", cwd=folder).stdout)
    assert (found["method"], found["chains"], found["draws"]) == ("laplace", 1, 4000)
    assert {"amplitude", "max_size_mm", "noise_sd"} <= set(found["variables"])
    assert found["provenance"]["command"] == "estimate"


def test_a_calibration_of_the_program_is_known_by_its_name_and_tells_all_its_parts(tmp_path: Path) -> None:
    found = json.loads(run_here("show", "solid", "--json", cwd=tmp_path).stdout)
    stored = json.loads((Path(tactile_bayes.__file__).parent / "calibrations" / "solid.json").read_text())
    assert found["constants"] == stored["constants"]
    assert found["residual_points"] == len(stored["residual"]["points"]) == 100
    assert found["fat_mm"] == stored["depth"]["fat_mm"]
    assert found["other_source"] == stored["spread"]["other_source"] == "16 lumps of other_simulator.csv"


def test_a_file_goes_before_a_calibration_of_its_name(tmp_path: Path) -> None:
    (tmp_path / "solid").write_bytes((DEMO / "trial.csv").read_bytes())
    assert json.loads(run_here("show", "solid", "--json", cwd=tmp_path).stdout)["kind"] == "table: trial"


def test_a_table_is_known_with_a_letter_across_the_end_of_its_first_bytes(tmp_path: Path) -> None:
    header = "patient,mass,modality,replicate,size_mm,status,reader\n"
    rows = "".join(f"S{i},1,tactile,1,12.5,detected,{'å' * 2100}\n" for i in range(3))
    for more in ("", "x"):  # a letter is two bytes: one of the two files has one at bytes 4095 and 4096
        (tmp_path / "a.csv").write_text(header + more + rows, encoding="utf-8")
        assert json.loads(run_here("show", "a.csv", "--json", cwd=tmp_path).stdout)["rows"] == 3


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("none", None),
        ("empty", b""),
        ("noise", bytes(range(256))),
        ("cut.nc", b"\x89HDF\r\n\x1a\n"),
        ("other.json", b'{"a": 1}'),
        ("cut.json", b'{"schema": "tactile-bayes/est'),
        ("list.json", b"[1, 2]"),
        ("scene.toml", b"[scene]\nseed = 1\n"),
        ("nothing.json", b"[]"),
        ("other.csv", b"a,b\n1,2\n"),
        ("cut.mcap", b"\x89MCAP0\r\n"),
    ],
)
def test_a_foreign_file_is_one_line_and_exit_3(tmp_path: Path, name: str, data: bytes | None) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    done = run_here("show", name, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"error: {name}: ")


def test_a_fact_that_holds_lines_is_one_line(tmp_path: Path) -> None:
    """A subject of "P1, new line, side right" showed a second side."""
    (tmp_path / "x.json").write_text('{"schema": "tactile-bayes/plan/1", "subject": "P1\\n  side  right"}')
    assert r"subject  P1\n  side  right" in run_here("show", "x.json", cwd=tmp_path).stdout


def test_many_numbers_are_counted_and_many_words_are_shown() -> None:
    lines = list(fact_lines({"a": [[0.5, 1.5]] * 20, "b": ["word"] * 40, "c": (5.0, 14.0)}))
    assert lines[2] == "c  5, 14"
    assert lines[0] == "a  40 numbers, 0.5 to 1.5"
    assert lines[1].count("word") == 40
