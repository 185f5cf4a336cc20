"""Estimates, posteriors and maps with damaged content: one clear line or a sound output, never a traceback or a NaN."""

from __future__ import annotations

import copy
import json
import random
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from in_process import run_here

import tactile_bayes as tb

DEMO = Path(tb.__file__).parent / "demo"
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.5, 1e308, -1e308, 1e-320, 2**53, "", "1e5", "x", "\x1b[2J", "a\rb", "\x07", "\u202e",
    "<script>alert(1)</script>", "=1+1", [], {}, [1, 2], [[]], {"a": 1}, "2026-13-40", "9" * 400, 1e20, -3.7, 360,
)  # fmt: skip
IDENTITY = ("--patient-id", "P1")
COMMANDS: dict[str, tuple[str, ...]] = {
    "page.html": ("report", "SOURCE", "-o", "page.html"),
    "fhir.json": ("export", "SOURCE", "--to", "fhir", "-o", "fhir.json", *IDENTITY),
    "records.csv": ("export", "SOURCE", "--to", "csv", "-o", "records.csv", *IDENTITY),
    "dicom": (
        "export",
        "SOURCE",
        "map.nc",
        "--to",
        "dicom",
        "-o",
        "dicom",
        "--study-date",
        "2026-01-02T10:00",
        *IDENTITY,
    ),
    "shown": ("show", "SOURCE"),
}
OF_DRAWS = {**COMMANDS, "figures": ("diagnose", "SOURCE"), "figures as JSON": ("diagnose", "SOURCE", "--json")}
OF_MAPS: dict[str, tuple[str, ...]] = {
    "dicom": ("export", "SOURCE", "--to", "dicom", "-o", "dicom", "--study-date", "2026-01-02T10:00", *IDENTITY),
    "map.nrrd": ("export", "SOURCE", "--to", "nrrd", "-o", "map.nrrd"),
    "sizes": ("estimate", "SOURCE", "--method", "laplace", "--json"),
    "shown": ("show", "SOURCE"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map, its estimate and posterior, one without a lump, and one of two maps."""
    made = tmp_path_factory.mktemp("damaged")
    tb.demo_map().save(made / "map.nc")
    for scene, name in (("scene.toml", "two.nc"), ("empty.toml", "empty.nc")):
        tb.build_map(tb.simulate(DEMO / scene, seed=2)).save(made / name)
    for name, words in {
        "one": ("map.nc", "-o", "post.nc"),
        "none": ("empty.nc",),
        "pool": ("map.nc", "two.nc", "--pool"),
    }.items():
        (made / f"{name}.json").write_text(run_here("estimate", *words, "--json", cwd=made).stdout)
    return made


def places(document: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where a document has values."""
    if place:
        yield place
    members = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    for key, value in members:
        yield from places(value, (*place, key))


def damaged(rng: random.Random, document: Any) -> Any:
    """A document with a value or a few exchanged, scaled, left out or put elsewhere."""
    document = copy.deepcopy(document)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        *way, last = rng.choice(list(places(document)))
        holder = document
        for key in way:
            holder = holder[key]
        value, what = holder[last], rng.randrange(8)
        if what < 4:
            holder[last] = rng.choice(VALUES)
        elif what == 4:
            del holder[last]
        elif what == 5 and isinstance(value, int | float) and not isinstance(value, bool):
            holder[last] = value * rng.choice((-1, 1e3, 1e9, 1e-9, 1e300))
        elif what == 6:
            other = document
            for key in rng.choice(list(places(document))):
                other = other[key]
            holder[last] = copy.deepcopy(other)
        elif isinstance(holder, dict):
            holder[rng.choice(("zzz", "\x1b", "a b", "median", "schema"))] = rng.choice(VALUES)
    return document


def damaged_netcdf(rng: random.Random, path: Path) -> None:
    """Damage arrays and attributes; JSON in an attribute is damaged within."""
    with h5py.File(path, "r+") as file:
        held: list[Any] = [file]
        file.visititems(lambda _, one: held.append(one))
        for _ in range(rng.choice((1, 1, 2, 3))):
            place = rng.choice(held)
            if isinstance(place, h5py.Dataset) and place.dtype.kind in "fi" and place.size and rng.random() < 0.4:
                values = np.atleast_1d(place[()]).ravel()
                chosen = rng.sample(range(values.size), min(values.size, rng.choice((1, 5, values.size))))
                number = rng.choice((np.nan, np.inf, -1.0, 0.0, 1e300, -1e9, 1e-300, 2.0**31))
                with np.errstate(all="ignore"):
                    values[chosen] = np.array(number).astype(values.dtype)
                place[...] = values.reshape(place.shape)
            elif place.attrs:
                name = rng.choice(list(place.attrs))
                text = place.attrs[name]
                if isinstance(text, str) and text.startswith("{"):
                    place.attrs[name] = json.dumps(damaged(rng, json.loads(text)))
                elif rng.random() < 0.2:
                    del place.attrs[name]
                else:
                    place.attrs[name] = rng.choice(("", "\x1b[2J", float("nan"), -1.0, 1e300, 0, "1e5", "x" * 300))


def check(folder: Path, source: str, commands: dict[str, tuple[str, ...]]) -> int:
    """Run each command on a damaged file; return how many took it."""
    taken = 0
    for output, words in commands.items():
        for old in (folder / output,):
            shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
        done = run_here(*(source if word == "SOURCE" else word for word in words), cwd=folder)
        assert done.returncode in (0, 2, 3, 6), (output, done.stderr)
        if done.returncode in (2, 3):
            assert done.stderr.startswith("error: "), (output, done.stderr)
            assert done.stderr.count("\n") == 1, done.stderr
            assert not (folder / output).exists()
            continue
        taken += 1
        made = folder / output
        texts = [done.stdout, *([made.read_text("utf-8")] if made.suffix in (".html", ".json", ".csv") else [])]
        for text in texts if output != "shown" else ():  # `show` says what a file holds, whatever it is
            number = re.search(r"(?<![\w/+=])(nan|NaN|inf|Infinity)(?![\w/+=])", text)
            assert number is None, (output, text[number.start() - 300 : number.end() + 100])
            assert not re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]", text), (output, text)
        if output == "dicom":
            read_dicom(made)
    return taken


def read_dicom(folder: Path) -> None:
    """Every value must be one that pydicom takes; its warnings are errors here."""
    pydicom = pytest.importorskip("pydicom")
    for path in folder.iterdir():
        for element in pydicom.dcmread(path).iterall():
            assert element.value is None or str(element.value) not in ("nan", "inf")


def run(folder: Path, names: tuple[str, ...], commands: dict[str, tuple[str, ...]], *, count: int, seed: int) -> None:
    rng, taken = random.Random(seed), 0
    for i in range(count):
        name = names[i % len(names)]
        source = folder / f"mutated{Path(name).suffix}"
        if name.endswith(".json"):
            source.write_text(json.dumps(damaged(rng, json.loads((folder / name).read_text()))))
        else:
            shutil.copy(folder / name, source)
            damaged_netcdf(rng, source)
        taken += check(folder, source.name, commands)
    assert 0 < taken < count * len(commands)  # some damage is none, and some is refused


@pytest.mark.long
def test_a_damaged_estimate_is_refused_in_one_line_or_told_without_nan(folder: Path) -> None:
    run(folder, ("one.json", "pool.json", "none.json"), COMMANDS, count=30, seed=20261125)


@pytest.mark.long
def test_a_damaged_posterior_is_refused_in_one_line_or_told_without_nan(folder: Path) -> None:
    run(folder, ("post.nc",), OF_DRAWS, count=6, seed=20261126)


@pytest.mark.long
def test_a_damaged_map_is_refused_in_one_line_or_told_without_nan(folder: Path) -> None:
    run(folder, ("map.nc",), OF_MAPS, count=8, seed=20261127)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "commands", "count"),
    [
        (("one.json", "pool.json", "none.json"), COMMANDS, 3000),
        (("post.nc",), OF_DRAWS, 1500),
        (("map.nc",), OF_MAPS, 1500),
    ],
    ids=["estimate", "posterior", "map"],
)
def test_thousands_of_damaged_files(
    folder: Path, names: tuple[str, ...], commands: dict[str, tuple[str, ...]], count: int
) -> None:
    run(folder, names, commands, count=count, seed=count)


@pytest.mark.long
def test_a_map_whose_list_of_scales_is_of_another_type_is_one_line(folder: Path) -> None:
    """HDF5 ended the process over it."""
    shutil.copy(folder / "map.nc", folder / "scales.nc")
    with h5py.File(folder / "scales.nc", "r+") as file:
        file["mean"].attrs["DIMENSION_LIST"] = "x"
    done = run_here("estimate", "scales.nc", cwd=folder)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "variable mean has dimensions" in done.stderr


@pytest.mark.long
def test_an_estimate_with_half_of_its_outline_is_one_line(folder: Path) -> None:
    """The page asked for the other half and ended in a traceback."""
    document = json.loads((folder / "one.json").read_text())
    del document["diagnostics"]["oval_half_log_ratio"]
    (folder / "half.json").write_text(json.dumps(document))
    done = run_here("report", "half.json", "-o", "half.html", cwd=folder)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "oval_half_log_ratio" in done.stderr
