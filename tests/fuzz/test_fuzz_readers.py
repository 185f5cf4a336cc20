"""A few damaged files of every format, each read or refused in one line; tests/fuzz/fuzz_readers.py has the many."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from fuzz_mutations import mutate
from fuzz_seeds import FORMATS

from tactile_bayes.errors import TactileBayesError

QUICK = {"png": 60, "tiff": 60, "pgm": 60, "toml": 40, "npz scan": 40, "npz grid": 40, "csv table": 40, "csv wide": 40}


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "json"])
def test_damaged_files_are_read_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    form = FORMATS[name]
    seeds = form.seeds(tmp_path)
    path = tmp_path / f"input{form.suffix}"
    refusals: list[str] = []
    for number in range(QUICK.get(name, 25)):
        path.write_bytes(mutate(random.Random(f"{name} {number}"), seeds, name))
        for read in form.readers:
            try:
                read(path)
            except TactileBayesError as error:
                refusals.append(str(error))
    assert refusals  # damage that nobody notices would be no test
    assert not [line for line in refusals if "\n" in line]


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "json"])
def test_the_unmutated_files_are_accepted(name: str, tmp_path: Path) -> None:
    form = FORMATS[name]
    for seed in form.seeds(tmp_path):
        path = tmp_path / f"seed{form.suffix}"
        path.write_bytes(seed)
        for read in form.readers:
            read(path)
