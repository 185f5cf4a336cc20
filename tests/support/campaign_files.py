"""A small study: the packaged scan thinned in several ways, with an empty, a damaged and a swapped file."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.scans import PressureFrames, Scan

DEMO = Path(__file__).resolve().parents[2] / "tactile_bayes" / "demo"
EXCISION = "patient,mass,ex_vivo_mm\n07,1,15.0\n09,1,14\n11,1,9\n12,1,10\n"
JOURNAL = "campaign.journal"
FAST = ("--method", "laplace", "--settings", Path(__file__).with_name("fast.toml"))
"""Options under which an exam is sized in half the time; its size is not what a test of campaigns is about."""


def thinned(start: int, step: int, **session: str) -> Scan:
    """The packaged scan with one frame of every so many, as another exam; the session is added to its own."""
    scan = tb.demo_scan()
    frames = PressureFrames(scan.frames.time_s[start::step], scan.frames.counts[start::step])
    return replace(scan, frames=frames, session={**scan.session, **session})


def level(start: int, **session: str) -> Scan:
    """A scan that feels no lump: a hand's pressure with noise, on the packaged scan's strokes."""
    scan = thinned(start, 2, **session)
    rng = np.random.default_rng(start)
    calibration = scan.element_calibration
    hand = 9.0 + 0.5 * np.sin(2.0 * scan.frames.time_s)
    kpa = hand[:, None, None] + 0.2 * rng.standard_normal(scan.frames.counts.shape)
    counts = np.rint((kpa - calibration.offset_kpa) / calibration.gain_kpa_per_count)
    return replace(scan, frames=PressureFrames(scan.frames.time_s, np.clip(counts, 0, 4000).astype(np.uint16)))


def write(path: Path, scan: Scan) -> None:
    """Write a scan."""
    write_scan(path, scan, provenance=Provenance("test", {}), force=True)


def write_study(folder: Path) -> None:
    """Scans of patients 07 (left, twice), 09 (right), 11 (no lump) and 12 (damaged), and one of 09 named as 07's."""
    scans = folder / "scans"
    scans.mkdir()
    write(scans / "07-a.mcap", thinned(0, 2, subject="07", side="left", examiner="R1"))
    write(scans / "07-b.mcap", thinned(1, 2, subject="07", side="left", examiner="R2"))
    write(scans / "09-a.mcap", thinned(0, 3, subject="09", side="right"))
    write(scans / "11-a.mcap", level(0, subject="11", side="left"))
    write(scans / "12-a.mcap", thinned(1, 3, subject="12", side="left"))
    write(scans / "swapped.mcap", thinned(2, 3, subject="09", side="right"))
    damaged = bytearray((scans / "12-a.mcap").read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    (scans / "12-a.mcap").write_bytes(damaged)
    (folder / "excision.csv").write_text(EXCISION)


ROWS = (
    ("scans/07-a.mcap", "07", 1, "left"),
    ("scans/07-b.mcap", "07", 2, "left"),
    ("scans/swapped.mcap", "07", 3, "left"),
    ("scans/09-a.mcap", "09", 1, "right"),
    ("scans/11-a.mcap", "11", 1, "left"),
    ("scans/12-a.mcap", "12", 1, "left"),
)


def write_table(path: Path, rows: Iterable[tuple[str, str, int, str]] = ROWS) -> None:
    """``exams.csv`` with rows of file, patient, replicate and side."""
    lines = ["file,patient,visit,mass,replicate,side"]
    lines += [f"{file},{patient},1,1,{replicate},{side}" for file, patient, replicate, side in rows]
    path.write_text("\n".join(lines) + "\n")


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a campaign's folder but the journal, which holds times."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != JOURNAL)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def steps(folder: Path) -> list[str]:
    """Steps in the journal, ``map 07.v1.m1.r1``, in the order in which they were done; digests of inputs left out."""
    lines = (folder / JOURNAL).read_text().splitlines()[1:]
    done = [" ".join(line.split('"')[3].split(" ")[:2]) for line in lines]
    return [one for one in done if not one.startswith("read ")]


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def arrays_of(scan: Scan) -> dict[str, np.ndarray | float]:
    """A scan as the arrays that `import` takes, without landmarks."""
    return {
        "counts": scan.frames.counts,
        "frame_time_s": scan.frames.time_s,
        "position_mm": scan.poses.position_mm,
        "quaternion_wxyz": scan.poses.quaternion_wxyz,
        "pose_time_s": scan.poses.time_s,
        "gain_kpa_per_count": scan.element_calibration.gain_kpa_per_count,
        "offset_kpa": scan.element_calibration.offset_kpa,
        "pitch_mm": scan.head.pitch_mm,
        "array_from_tracker": scan.head.scanhead_from_tracker,
        "head_surface_mm": scan.head.surface_mm,
    }
