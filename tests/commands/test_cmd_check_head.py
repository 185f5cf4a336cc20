"""A phantom checks a head once: scans with that head need not show again that it is right."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.files.instrument import read_head_geometry
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.scans import PressureFrames, Scan


def even(scan: Scan) -> Scan:
    """The scan over skin in which nothing stands out."""
    rng = np.random.default_rng(1)
    flat = scan.frames.counts.mean(axis=0) + 8.0 * rng.standard_normal(scan.frames.counts.shape)
    return replace(scan, frames=PressureFrames(scan.frames.time_s, flat.astype(np.uint16)))


@pytest.mark.long
def test_a_checked_head_carries_its_day_to_the_maps_of_other_scans(tmp_path: Path) -> None:
    phantom = tb.demo_scan()
    write_scan(tmp_path / "phantom.mcap", phantom, provenance=Provenance("test", {}))
    done = run_here("check", "phantom.mcap", "-o", "head.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "head.json: the head, checked on " in done.stdout
    head = read_head_geometry(tmp_path / "head.json")
    assert head.checked_on
    assert np.array_equal(head.scanhead_from_tracker, phantom.head.scanhead_from_tracker)
    unchecked = even(phantom)
    assert "arrangement_unknown" in [one.kind for one in build_map(unchecked).findings]
    checked = replace(unchecked, head=head)
    assert "arrangement_unknown" not in [one.kind for one in build_map(checked).findings]
    write_scan(tmp_path / "exam.mcap", checked, provenance=Provenance("test", {}))
    assert read_scan(tmp_path / "exam.mcap").head.checked_on == head.checked_on


def test_a_scan_that_shows_nothing_checks_no_head(tmp_path: Path) -> None:
    write_scan(tmp_path / "even.mcap", even(tb.demo_scan()), provenance=Provenance("test", {}))
    done = run_here("check", "even.mcap", "-o", "head.json", cwd=tmp_path)
    assert done.returncode != 0
    assert "does not show that its head is right" in done.stderr
    both = run_here("check", "even.mcap", "even.mcap", "-o", "head.json", cwd=tmp_path)
    assert both.returncode == 2
    assert "-o takes the head of one scan" in both.stderr
    assert not (tmp_path / "head.json").exists()


def test_an_unchecked_head_is_written_as_before(tmp_path: Path) -> None:
    write_scan(tmp_path / "a.mcap", tb.demo_scan(), provenance=Provenance("test", {}))
    assert b"checked_on" not in (tmp_path / "a.mcap").read_bytes()
    assert "checked_on" not in json.dumps(run_here("show", "a.mcap", "--json", cwd=tmp_path).stdout)
