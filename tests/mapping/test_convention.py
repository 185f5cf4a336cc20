"""Rotations told in a wrong order or sense: refused or told, whatever the mount; rightly told ones are left alone."""

from __future__ import annotations

from functools import cache

import mapping_scans as scans
import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import finding
from tactile_bayes.geometry import inverse, quaternion_from_rotation, rigid, rotation_from_quaternion
from tactile_bayes.mapping import convention
from tactile_bayes.mapping.arrangement import check_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.convention import CONVENTIONS, check_convention, convention_findings, import_again
from tactile_bayes.mapping.select import SelectedFrames, select_frames
from tactile_bayes.report.map import map_text
from tactile_bayes.scans import HeadGeometry, Scan, TrackerPoses

WRONG = list(CONVENTIONS)[1:]
SCANS = 60


def turned(rng: np.random.Generator) -> np.ndarray:
    """A rotation from nowhere in particular."""
    return rotation_from_quaternion(rng.standard_normal(4))


@cache
def scan_of(seed: int, *, lean_deg: float = 0.0) -> Scan:
    """Strokes on a plane that lies anyhow, with the tracker mounted anyhow; the handle rocks by 2 degrees."""
    rng = np.random.default_rng(seed)
    base = rigid(turned(rng), rng.normal(0, 300, 3))
    mount = rigid(turned(rng), np.array([0.0, 0.0, rng.uniform(20, 150)]))
    plain = scans.make_scan(scans.strokes(lines=5, per_line=40), yaw_deg=3 * np.sin(np.arange(200) / 9))
    poses = []
    for place, wxyz, t in zip(plain.poses.position_mm, plain.poses.quaternion_wxyz, np.arange(200), strict=True):
        rock = scans.rotation(lean_deg + 2 * np.sin(t / 11), about=(np.sin(t / 25), np.cos(t / 25), 0.0))
        poses.append(base @ rigid(rotation_from_quaternion(wxyz) @ rock, place) @ mount)
    quaternion = np.array([quaternion_from_rotation(pose[:3, :3]) for pose in poses])
    place = np.array([pose[:3, 3] for pose in poses])
    head = HeadGeometry(plain.head.surface_mm, plain.head.pitch_mm, mount)
    return replace(plain, head=head, poses=TrackerPoses(plain.poses.time_s, place, quaternion))


def told(scan: Scan, name: str) -> Scan:
    """The scan as a file would hold it that tells rotations in another convention."""
    stored = scan.poses.quaternion_wxyz
    stored = stored * [1.0, -1.0, -1.0, -1.0] if "inverse" in name else stored
    stored = np.roll(stored, -1, axis=1) if "last" in name else stored
    return replace(scan, poses=TrackerPoses(scan.poses.time_s, scan.poses.position_mm, stored))


def selected(scan: Scan) -> list[SelectedFrames]:
    return [select_frames(scan, pressure_window_kpa=(5.0, 14.0))]


def verdict(scan: Scan) -> str:
    try:
        return "doubted" if "other_convention" in check_convention(selected(scan)) else "passed"
    except BadDataError:
        return "refused"


@pytest.mark.long
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_convention_hardly_ever_passes(name):
    verdicts = [verdict(told(scan_of(seed), name)) for seed in range(SCANS)]
    assert verdicts.count("refused") > 0.6 * SCANS
    assert verdicts.count("passed") <= 0.1 * SCANS


def test_import_and_check_refuse_what_map_refuses():
    """They said that all is as it is stated, and map then refused the scan."""
    scan = next(one for seed in range(SCANS) if verdict(one := told(scan_of(seed), WRONG[0])) == "refused")
    with pytest.raises(BadDataError, match=r"the head's face and its motion are .* or check order and unit of angles"):
        check_scan(scan, thorough=False)


@pytest.mark.long
def test_the_right_convention_passes():
    assert [verdict(scan_of(seed)) for seed in range(SCANS)] == ["passed"] * SCANS


@pytest.mark.long
def test_a_face_that_leans_on_its_motion_is_not_refused():
    verdicts = [verdict(scan_of(seed, lean_deg=15.0)) for seed in range(SCANS)]
    assert "refused" not in verdicts


def sinking(scan: Scan, *, mm_per_kpa: float) -> Scan:
    """The scan with a pressure that rises from 6 to 12 kPa and falls to 9, over tissue that yields so much."""
    level = 9.0 + 3.0 * np.sin(np.pi * np.linspace(-0.5, 1.0, len(scan.frames.time_s)))
    counts = scan.frames.counts * (level / scans.LEVEL_KPA)[:, None, None]
    tracker = rotation_from_quaternion(scan.poses.quaternion_wxyz)
    normal = tracker @ inverse(scan.head.scanhead_from_tracker)[:3, 2]
    place = scan.poses.position_mm + mm_per_kpa * (level - 9.0)[:, None] * normal
    poses = TrackerPoses(scan.poses.time_s, place, scan.poses.quaternion_wxyz)
    return replace(scans.with_counts(scan, np.rint(counts).astype(np.uint16)), poses=poses)


@pytest.mark.long
def test_a_head_that_sinks_into_soft_tissue_is_not_refused(monkeypatch):
    """It sinks as far as it slides from line to line. The control: with the sinking left in, most are refused."""
    soft = [sinking(scan_of(seed), mm_per_kpa=3.0) for seed in range(SCANS)]
    assert "refused" not in [verdict(scan) for scan in soft]
    refused = [verdict(told(scan, WRONG[0])) for scan in soft].count("refused")
    assert refused > 0.6 * SCANS
    monkeypatch.setattr(convention, "_without_sinking", lambda places, _: places)
    monkeypatch.setattr(convention, "_agreement_on_a_sphere", lambda _: 0.0)  # it takes the pressure off, too
    assert [verdict(scan) for scan in soft].count("refused") > 0.5 * SCANS


@pytest.mark.long
def test_a_doubt_is_told_with_the_convention_that_fits():
    doubted = [(name, told(scan_of(seed), name)) for seed in range(SCANS) for name in WRONG]
    doubted = [(name, scan) for name, scan in doubted if verdict(scan) == "doubted"]
    best = [list(CONVENTIONS)[int(check_convention(selected(scan))["other_convention"])] for _, scan in doubted]
    assert np.mean([name == told_as for (name, _), told_as in zip(doubted, best, strict=True)]) > 0.8
    texts = []
    for name, scan in doubted:
        try:
            texts.append((name, map_text(build_map(scan))))
        except BadDataError:  # the plane of the taxels is another one yet
            continue
    assert any(f"; the quaternions seem to be {name}: the head's face" in text for name, text in texts)


def test_a_motion_along_a_line_tells_nothing_and_the_report_says_so():
    scan = scans.make_scan(scans.strokes(lines=1, per_line=60))
    assert check_convention(selected(scan)) == {}
    assert "check that the quaternions are scalar first" in map_text(build_map(scan))
    crossed = map_text(build_map(scans.make_scan(scans.strokes(lines=5, per_line=60))))
    assert "does not tell" not in crossed  # the control
    assert "face and motion agree to 1.000 of 1" in crossed


def test_the_way_to_the_skin_does_not_count():
    """Poses without a used frame near them may go any way."""
    scan = scan_of(1)
    away = np.arange(200) / 50.0 + scan.poses.time_s[-1] + 0.06
    lift = np.linspace(0, 500, 200)[:, None] * inverse(np.eye(4))[2, :3]
    poses = TrackerPoses(
        np.concatenate([scan.poses.time_s, away]),
        np.concatenate([scan.poses.position_mm, scan.poses.position_mm[-1] + lift]),
        np.concatenate([scan.poses.quaternion_wxyz, scan.poses.quaternion_wxyz]),
    )
    assert check_convention(selected(replace(scan, poses=poses))) == check_convention(selected(scan))


@pytest.mark.parametrize(
    ("corrections", "told"), [(["rows-reversed"], True), (["rows-reversed", "columns-reversed"], False), ([], False)]
)
def test_an_array_that_seems_mirrored_may_be_a_left_handed_tracker(corrections, told):
    """A lump on the patient's right was told on the left after the correction that the check named."""
    assert ("left-handed" in import_again(corrections)) == told


def test_rotations_that_the_frames_ask_for_too_are_told_once():
    doubted = {"other_convention": 2.0, "other_agreement": 0.999, "normal_agreement": 0.95}
    (alone,) = convention_findings(doubted, [])
    assert "import the scan again with --correct inverse-rotation" in alone.remedy
    asked = finding("wrong_arrangement", "words", import_again(["rows-reversed", "inverse-rotation"]))
    assert convention_findings(doubted, [asked]) == ()
    assert convention_findings(doubted, [replace(asked, remedy=import_again(["rows-reversed"]))]) == (alone,)
