"""A site's repeatability as a file: what was written is read, and what cannot be one is refused by its fault."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from repeated_exams import write_repeats

from tactile_bayes.actions.show import describe
from tactile_bayes.api.repeatability import exams_of_campaign, learn_from_exams
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.size_json import read_repeatability


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file learned from four masses, and beside it the folder that it is from."""
    folder = tmp_path_factory.mktemp("site")
    learned = learn_from_exams(exams_of_campaign(write_repeats(folder / "out", 4)))
    learned.write(folder / "site.json")
    return folder / "site.json"


def test_a_written_repeatability_is_read_back(written: Path) -> None:
    learned = learn_from_exams(exams_of_campaign(written.parent / "out")).spread()
    read = read_repeatability(written)
    assert read.sha256 == sha256(written)
    for name in ("sd", "log_sd", "median", "low", "high"):
        assert getattr(read, name) == pytest.approx(getattr(learned, name), rel=1e-8)
    same = dict.fromkeys(("sd", "log_sd", "median", "low", "high"), 0.05)
    assert replace(read, **same, sha256="") == replace(learned, **same)


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "no spread": ({"between_map_sd": 0.0}, "between_map_sd is 0.0; give a number above 0"),
    "a key too many": ({"tau": 0.1}, "tau is not known"),
    "two masses": ({"masses": 2}, "masses is 2; give a whole number from 3"),
    "an interval without its median": (
        {"low": 0.2, "median": 0.1},
        "the spread has the median 0.1 and the interval 0.2",
    ),
    "a spread of no site": ({"between_map_sd": 3.0}, "between_map_sd is 3.0; give a number .* to 2"),
    "another kind": ({"schema": "tactile-bayes/plan/1"}, "is a trial plan"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_an_impossible_repeatability_is_refused_by_its_fault(case: str, written: Path, tmp_path: Path) -> None:
    changes, fault = FAULTS[case]
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(json.loads(written.read_text()) | changes))
    with pytest.raises(BadDataError, match=fault):
        read_repeatability(path)


def test_a_strange_provenance_is_shown_as_it_is(written: Path, tmp_path: Path) -> None:
    path = tmp_path / "strange.json"
    strange = {"inputs": ["x", {"no": 1}, {"role": "draws_7"}]}
    path.write_text(json.dumps(json.loads(written.read_text()) | {"provenance": strange}))
    assert describe(path)["provenance"] == {"inputs": ["x", {"no": 1}]}


@pytest.mark.parametrize(
    ("fault", "value", "words"),
    [
        ("settings", {}, "does not say by which calibration; run the campaign again"),
        ("settings", [1], "provenance.settings is .1.; give a table"),
        ("inputs", [1], "provenance.inputs.0. is 1; give a table"),
    ],
)
def test_an_estimate_that_does_not_say_its_calibration_is_refused(
    fault: str, value: object, words: str, tmp_path: Path
) -> None:
    out = write_repeats(tmp_path / "out", 3, maps=2)
    path = out / "exams" / "02.v1.m1.r1" / "estimate.json"
    document = json.loads(path.read_text())
    document["provenance"][fault] = value
    path.write_text(json.dumps(document))
    with pytest.raises(BadDataError, match=words):
        learn_from_exams(exams_of_campaign(out))
