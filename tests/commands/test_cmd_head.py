"""`--head`: it moves the numbers of every command that takes it, and naming the default changes nothing."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from tactile_bayes.actions import study as tables
from tactile_bayes.actions.study import study_settings
from tactile_bayes.cli import cli
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report
from tactile_bayes.options import SectionOptions, StudyOptions
from tactile_bayes.presets import HEADS, SHOULDERS_INSIDE, SHOULDERS_OUTSIDE

DEFAULTS = {"plane-strain": SHOULDERS_INSIDE, "empirical": SHOULDERS_INSIDE, "solid": SHOULDERS_OUTSIDE}
# The layers without a lump, so that nothing is meshed; four frames.
SCENE = "[scene]\nseed = 4\nduration_s = 0.02\n[background]\nramp_s = 0\n[body]\nfat_mm = 15\n"
# Of the paper's 150 cases those whose amplitude passes 0.02 with the head, and one on either side that does not care.
MOVED = [(10, 1.5, 5), (15, 1.5, 5), (15, 1.5, 8), (20, 1.5, 10)]
STAY = [(10, 1.5, 2), (15, 1.5, 100)]
CASE = ("d_mm", "depth_ratio", "stiffness_ratio")


def run(*words: object) -> str:
    done = CliRunner().invoke(cli, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.stdout


def head_words(head: str | None) -> list[str]:
    return [] if head is None else ["--head", head]


@pytest.mark.parametrize("fidelity", DEFAULTS)
def test_simulate_feels_another_head_and_its_default_by_name(fidelity: str, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SCENE)
    scans, truths = {}, {}
    for head in (None, *HEADS):
        path = tmp_path / f"{head}.mcap"
        said = run("simulate", tmp_path / "s.toml", "-o", path, "--fidelity", fidelity, *head_words(head))
        assert f"head: {head or DEFAULTS[fidelity]}" in said
        scans[head], truths[head] = read_scan(path), read_scan_report(path).truth
    default = DEFAULTS[fidelity]
    (other,) = (head for head in HEADS if head != default)
    named, plain = scans[default], scans[None]
    np.testing.assert_array_equal(named.frames.counts, plain.frames.counts)
    np.testing.assert_array_equal(named.head.surface_mm, plain.head.surface_mm)
    np.testing.assert_array_equal(named.poses.position_mm, plain.poses.position_mm)
    assert truths[default] == truths[None]
    change = scans[other].frames.counts.astype(int) - plain.frames.counts
    assert np.abs(change).max() > 0.05 * plain.frames.counts.max()
    assert truths[other] != truths[None]


@pytest.mark.long
def test_the_tables_of_another_head_are_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """One deep lump of the ten, and the deep one of the phantoms."""
    few = {"table_scenes": slice(7, 8), "phantom_scenes": slice(2, 3)}
    for name, taken in few.items():
        scenes = getattr(tables, name)
        monkeypatch.setattr(tables, name, lambda seat, scenes=scenes, taken=taken: scenes(seat)[taken])
    found: dict[str | None, dict[str, Any]] = {
        head: json.loads(run("tables", "--json", *head_words(head))) for head in (None, *HEADS)
    }
    assert found[None] == found[SHOULDERS_INSIDE]
    assert [found[head]["head"] for head in HEADS] == list(HEADS)
    for part in ("cases", "phantoms"):
        (inside,), (outside,) = (found[head][part] for head in HEADS)
        assert inside["scene"] == outside["scene"]
        assert abs(outside["elastic"]["amplitude"] / inside["elastic"]["amplitude"] - 1) > 0.1
        assert outside["centred_frame"] < 0.5 * inside["centred_frame"]


@pytest.mark.long
def test_how_many_cases_cannot_be_seen_depends_on_the_head(tmp_path: Path) -> None:
    """Record 0075 has 47 and 38 of 150: a few of the nine between, and two that stay what they are."""
    grid = tmp_path / "grid.csv"
    lines = [f"{d},{depth},{ratio}" for d, depth, ratio in MOVED + STAY]
    grid.write_text("\n".join(["d_mm,depth_ratio,stiffness_ratio", *lines]) + "\n")
    shown, output = {}, {}
    for head in (None, *HEADS):
        words = ("study", "--grid", grid, "--fineness", 1, "-o", tmp_path / f"{head}.csv", *head_words(head))
        output[head] = run(*words)
        rows = csv.DictReader((tmp_path / f"{head}.csv").read_text().splitlines())
        shown[head] = {tuple(float(row[name]) for name in CASE): row["detectable"] == "true" for row in rows}
    assert "6 cases, 5 not detectable" in output[SHOULDERS_INSIDE]
    assert "6 cases, 1 not detectable" in output[SHOULDERS_OUTSIDE]
    assert shown[None] == shown[SHOULDERS_INSIDE]
    changed = {case for case, seen in shown[SHOULDERS_INSIDE].items() if seen != shown[SHOULDERS_OUTSIDE][case]}
    assert changed == set(MOVED)


@pytest.mark.parametrize(("model", "default"), [("plane-strain", SHOULDERS_INSIDE), ("solid", SHOULDERS_OUTSIDE)])
def test_each_model_of_the_study_has_its_default_by_name(model: str, default: str) -> None:
    found = {head: study_settings(StudyOptions(model=model, head=head), SectionOptions()) for head in (None, *HEADS)}
    assert found[default] == found[None]
    assert found[HEADS[0]] != found[HEADS[1]]


@pytest.mark.slow
@pytest.mark.parametrize(("head", "unseen"), [(SHOULDERS_INSIDE, 47), (SHOULDERS_OUTSIDE, 38)])
def test_of_the_papers_150_cases_so_many_cannot_be_seen(head: str, unseen: int, tmp_path: Path) -> None:
    said = run("study", "--head", head, "--fineness", 1, "-o", tmp_path / "s.csv")
    assert f"150 cases, {unseen} not detectable" in said
