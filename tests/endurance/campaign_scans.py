"""Scan files for trials of any size: each body is solved once, and its exams differ by the instrument's chance alone.

    python tests/endurance/campaign_scans.py DIR --patients 2500 --exams 4 --bodies 250

makes `DIR/scans/` and `DIR/excision.csv`. Patient i has body i modulo the number of bodies: what a head feels over the
body's lump is solved in three dimensions, 200 frames in 2.5 s. Each exam draws element gains, noise and tracker error
anew from a seed of its own, so no two files have the same bytes. One body in 20 holds no lump. One file in 250 is cut
off and one in 250 has a flipped byte.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.forward import scene as scenes
from tactile_bayes.forward.scene import Background, Noise, Scene, Strokes, frame_times, record
from tactile_bayes.forward.simulate import frames_at_poses
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from tactile_bayes.scans import Scan

EMPTY_EVERY, CUT_EVERY, DAMAGED_EVERY = 20, 250, 250
SEED = 20261124


@dataclass(frozen=True, slots=True)
class Faults:
    """How many exams there are to one of each kind of fault; 0 for none."""

    cut: int = CUT_EVERY
    damaged: int = DAMAGED_EVERY


def draw_scene(body: int, *, empty_every: int = EMPTY_EVERY) -> Scene:
    """Scene of one body, a quick exam of 2.5 s."""
    rng = np.random.default_rng([SEED, body])
    d = float(rng.uniform(9.0, 22.0))
    lump = SolidLump(d_mm=d, depth_ratio=float(rng.uniform(0.7, 1.2)), stiffness_ratio=float(rng.choice([15.0, 50.0])))
    fat = lump.depth_mm
    layers = SceneBody(
        fat_kpa=float(rng.uniform(4.0, 6.5)),
        gland_ratio=float(rng.uniform(7.0, 12.0)),
        thickness_mm=float(rng.uniform(50.0, 70.0)),
        fat_mm=fat,
    )
    empty = empty_every > 0 and body % empty_every == empty_every - 1
    return Scene(
        duration_s=2.5,
        frame_rate_hz=80.0,
        body=layers,
        solid_lumps=() if empty else (lump,),
        background=Background(mean_kpa=9.5),
        strokes=Strokes(lines=3, spacing_mm=8.0, half_length_mm=32.0),
        noise=Noise(element_kpa=0.2, tracker_mm=0.4, tracker_deg=0.2),
    )


class Body:
    """One body with what the head feels over it, solved once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._time = frame_times(scene)
        level = scenes.level_kpa(scene.background, self._time)
        poses = scenes.head_poses(scene, self._time)
        self._pressure, self._depth = frames_at_poses(scene, *poses, mean_kpa=level)

    @property
    def ex_vivo_mm(self) -> float:
        """Diameter of the lump; 10 mm, which nobody can measure, where there is none."""
        return self.scene.solid_lumps[0].d_mm if self.scene.solid_lumps else 10.0

    def exam(self, seed: int, **session: str) -> Scan:
        """One exam: the same strokes with gains, noise and tracker error of their own."""
        made = record(
            self.scene,
            pressure=lambda at: self._pressure[np.searchsorted(self._time, at)],
            depth=lambda at: np.interp(at, self._time, self._depth),
            truth={"model": "solid", "lumps": []},
            rng=np.random.default_rng([SEED, seed]),
        )
        return replace(made.scan, session={**made.scan.session, **session})


def make(
    folder: Path,
    *,
    patients: int,
    exams: int,
    bodies: int,
    faults: Faults | None = None,
    empty_every: int = EMPTY_EVERY,
) -> None:
    """Write scans and excision.csv; scans that are there already stay."""
    faults = Faults() if faults is None else faults
    (folder / "scans").mkdir(parents=True, exist_ok=True)
    ex_vivo = {}
    for number in range(bodies):
        body = Body(draw_scene(number, empty_every=empty_every))
        for patient in range(number, patients, bodies):
            ex_vivo[patient] = body.ex_vivo_mm
            for exam in range(exams):
                _write(folder, body, patient, exam, serial=patient * exams + exam, faults=faults)
        print(f"body {number + 1} of {bodies}", flush=True)
    lines = [f"{code(patient)},1,{mm:.2f}" for patient, mm in sorted(ex_vivo.items())]
    (folder / "excision.csv").write_text("\n".join(["patient,mass,ex_vivo_mm", *lines]) + "\n")


def code(patient: int) -> str:
    """Code of a patient."""
    return f"P{patient + 1:05d}"


def _write(folder: Path, body: Body, patient: int, exam: int, *, serial: int, faults: Faults) -> None:
    path = folder / "scans" / f"{code(patient)}-{'abcdefgh'[exam]}.mcap"
    if path.exists():
        return
    session = {"subject": code(patient), "side": ("left", "right")[patient % 2], "examiner": f"R{exam % 3 + 1}"}
    scan = body.exam(serial, **session)
    write_scan(path, scan, provenance=Provenance("campaign scans", {}, {}, seed=serial))
    for data in _damage(path.read_bytes(), serial, faults):
        path.write_bytes(data)


def _damage(data: bytes, serial: int, faults: Faults) -> Iterator[bytes]:
    """The file as an accident leaves it; nothing where there is none."""
    if faults.cut and serial % faults.cut == faults.cut - 1:
        yield data[: len(data) // 3]
    elif faults.damaged and serial % faults.damaged == faults.damaged // 2:
        flipped = bytearray(data)
        flipped[len(data) // 2] ^= 0xFF
        yield bytes(flipped)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--patients", type=int, default=2500)
    parser.add_argument("--exams", type=int, default=4, help="per patient, at most 8")
    parser.add_argument("--bodies", type=int, default=250)
    args = parser.parse_args()
    make(args.folder, patients=args.patients, exams=args.exams, bodies=args.bodies)
