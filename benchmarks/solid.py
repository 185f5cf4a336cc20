"""The solid model: seconds a lump, milliseconds a frame, and what finer meshes cost and change.

``python -m benchmarks.solid [--runs N] [--json OUT]``. CPU time of this process, the least of several runs; set
OPENBLAS_NUM_THREADS=1 to compare machines by core. "off" is the largest change of a frame over the lump against the
finest mesh, as a share of the bump.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.forward.axisymmetric import CondensedLump, condense_lump, taxel_compliance
from tactile_bayes.forward.contact import ContactStiffness, solve_contact
from tactile_bayes.forward.mesh import LumpGeometry, MeshSize, lump_mesh
from tactile_bayes.forward.scene import Head
from tactile_bayes.forward.simulate import SkinPerturbation, SolidHead, head_face, skin_perturbation, solid_head
from tactile_bayes.forward.tissue import Layers

SCHEMA = "tactile-bayes/benchmarks/solid/1"
LUMPS = {
    "centred, h/d 1": LumpGeometry(7.5, 7.5, 15.0, Layers(15.0)),
    "resting, h/d 1": LumpGeometry(7.5, 7.5, 15.0, Layers(24.0)),
    "shallow, h/d 0.6": LumpGeometry(5.0, 5.0, 6.0, Layers(6.0)),
}
MESHES = {
    "coarse": MeshSize(arc=12, rings=4, core=2, grade=1.6),
    "default": MeshSize(),
    "fine": MeshSize(arc=26, rings=9, core=4, grade=1.35),
    "finest": MeshSize(arc=34, rings=12, core=6, grade=1.25),
}


def least_cpu(work: Callable[[], Any], runs: int) -> float:
    """Seconds of CPU of the quickest of `runs` runs."""
    best = np.inf
    for _ in range(runs):
        begun = time.process_time()
        work()
        best = min(best, time.process_time() - begun)
    return float(best)


def head_on(geometry: LumpGeometry) -> SolidHead:
    """The default head on the body of a lump."""
    return solid_head(Head(), geometry.layers)


def sweep(head: SolidHead, lumps: Sequence[SkinPerturbation], count: int = 60) -> list[Any]:
    """Frames of one stroke across the lump, each from the contact of the one before."""
    frames: list[Any] = []
    touching = None
    for x in np.linspace(-30.0, 30.0, count):
        frame, contact = head.frame(lumps, np.eye(3), (float(x), 2.0), mean_kpa=9.5, touching=touching)
        frames.append(frame)
        touching = contact.touching
    return frames


def mesh_rows(name: str, geometry: LumpGeometry, runs: int) -> list[dict[str, Any]]:
    """One row a mesh: unknowns, seconds, and how far off a frame over the lump is."""
    head, made = head_on(geometry), dict[str, CondensedLump]()
    rows = []
    for mesh, size in MESHES.items():
        seconds = least_cpu(lambda size=size: condense_lump(geometry, size=size), runs)
        made[mesh] = condense_lump(geometry, size=size)
        nodes = len(lump_mesh(geometry, size).nodes)
        rows.append({"lump": name, "mesh": mesh, "unknowns": 3 * nodes, "orders": len(made[mesh].modes), "s": seconds})
    plain = over(head, [])
    frames = {mesh: over(head, [skin_perturbation(lump, 500.0)]) for mesh, lump in made.items()}
    bump = np.abs(frames["finest"] - plain).max()
    for row in rows:
        row["off"] = float(np.abs(frames[row["mesh"]] - frames["finest"]).max() / bump)
    return rows


def over(head: SolidHead, lumps: Sequence[SkinPerturbation]) -> Any:
    """The frame centred on the lump."""
    return head.frame(lumps, np.eye(3), (0.0, 0.0), mean_kpa=9.5)[0]


def frame_rows(runs: int) -> list[dict[str, Any]]:
    """Milliseconds a frame without a lump, with one and with two, and for a plain inverse of the whole compliance."""
    geometry = LUMPS["centred, h/d 1"]
    head = head_on(geometry)
    ball = skin_perturbation(condense_lump(geometry), 500.0)
    placed = [ball, replace(ball, x_mm=30.0, y_mm=5.0)]
    rows = []
    for count in (0, 1, 2):
        lumps = placed[:count]
        seconds = least_cpu(lambda lumps=lumps: sweep(head, lumps), runs)
        rows.append({"what": f"frame, {count} lumps", "ms": 1000 * seconds / 60})
    surface, sensing = head_face(Head())
    rows_, columns = sensing.shape
    compliance = taxel_compliance(geometry.layers, rows=rows_, columns=columns, pitch_mm=1.5)
    height = -surface[..., 2].ravel()
    plain = least_cpu(lambda: solve_contact(ContactStiffness.of(compliance), height, mean_kpa=9.5), runs)
    return [*rows, {"what": "frame, inverse anew", "ms": 1000 * plain}]


def other_rows(runs: int) -> list[dict[str, Any]]:
    """What is done once a body and once a stiffness."""
    geometry = LUMPS["centred, h/d 1"]
    lump = condense_lump(geometry)
    return [
        {"what": "body and head", "ms": 1000 * least_cpu(lambda: head_on(geometry), runs)},
        {"what": "another stiffness", "ms": 1000 * least_cpu(lambda: skin_perturbation(lump, 50.0), runs)},
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, write JSON when asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.solid", description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="runs of each measurement (3)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures as JSON")
    options = parser.parse_args(arguments)
    head_on(LUMPS["centred, h/d 1"])  # imports are no part of any figure
    meshes = [row for name, geometry in LUMPS.items() for row in mesh_rows(name, geometry, options.runs)]
    print(f"{'lump':<18}{'mesh':<9}{'unknowns':>9}{'orders':>7}{'s':>8}{'off %':>8}")
    for row in meshes:
        print(
            f"{row['lump']:<18}{row['mesh']:<9}{row['unknowns']:>9}{row['orders']:>7}{row['s']:>8.2f}"
            f"{100 * row['off']:>8.2f}"
        )
    times = [*other_rows(options.runs), *frame_rows(options.runs)]
    for row in times:
        print(f"{row['what']:<24}{row['ms']:>8.2f} ms")
    if options.json:
        document = {"schema": SCHEMA, "runs": options.runs, "meshes": meshes, "times": times}
        options.json.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
