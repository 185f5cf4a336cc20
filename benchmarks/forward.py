"""What the plane-strain study costs: ``python -m benchmarks.forward [--json OUT]``, also in ``make bench-forward``.

The whole study on one process and on two, its memory, a contact problem, and how condensing grows with the mesh; all
against three other ways, measured in the same run:

* *anew*: at each position the whole body is solved with the touching part of its skin held, and factorised again
  whenever what touches changes. Its mesh is as fine along the whole travel of the head as the contact needs.
* *re-used*: the same mesh and elements as ours, mirrored to the whole body, and one sparse factorisation a stiffness
  kept for all positions, as a competent user would. At each position the cells under the head are its right-hand
  sides; their compliance goes to our contact solver.
* *condensed by force*: the same with all cells of the skin as right-hand sides, once a stiffness.

Only the time of the last two counts: a mesh that serves us, who take the layers from their exact answer and only the
lump's change from elements, is too coarse for the contact itself, and how far their frame is off is printed.

CPU seconds but where "wall" is said; run it on a quiet machine, with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from benchmarks.measure import environment
from tactile_bayes.forward.contact import FactoredCompliance, solve_contact
from tactile_bayes.forward.mesh import Mesh, body_mesh
from tactile_bayes.forward.plane import (
    build_line,
    condense,
    head_positions,
    plane_part,
    press,
    skin_average,
)
from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.forward.tissue import Body
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import MEAN_KPA
from tactile_bayes.studies.paper import fit_line

SCHEMA = "tactile-bayes/benchmark-forward/2"
BODY = Body(15.0, 1.0)
HARD = 100.0
CELL_MM = 1.0
REUSED_CELL_MM = 0.25


def seconds(work: Callable[[], object], *, runs: int = 3) -> float:
    """The least CPU time of a few runs."""
    times = []
    for _ in range(runs):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


# Peak memory of a process and of the largest of its children, after the study ran.
_STUDY = """
import resource, sys
from tactile_bayes.cli import cli
try:
    cli.main(["study", "--workers", sys.argv[1], "-o", sys.argv[2]], standalone_mode=False)
finally:
    peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    times = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print("measured", *peaks, sum(t.ru_utime + t.ru_stime for t in times))
"""


def study(workers: int) -> dict[str, float]:
    """The 150 cases by the command, start and table included, on so many processes."""
    unit = 1 if sys.platform == "darwin" else 1024
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", _STUDY, str(workers), f"{folder}/study.csv"],
            env=environment(),
            check=True,
            capture_output=True,
            text=True,
        )
        wall = time.perf_counter() - begun
    own, child, cpu = (float(word) for word in done.stdout.splitlines()[-1].split()[1:])
    # the children's peak is that of the largest: as if all of them had it, and all at once
    peak = own + (child * workers if workers > 1 else 0.0)
    return {"cpu_s": cpu, "wall_s": wall, "peak_mb": peak * unit / 1e6}


def contact_seconds() -> float:
    """One position of the head, among the 241 of a map."""
    surface, positions = condense(BODY), head_positions()
    return seconds(lambda: press(surface, HARD, positions)) / len(positions)


def growth() -> list[dict[str, float]]:
    """Condensing at several finenesses, with the figures that the map then has."""
    rows = []
    for fineness in (1, 2, 3, 4, 6):
        mesh = body_mesh(BODY, fineness=fineness, layered=True)
        spent = seconds(lambda fineness=fineness: condense(BODY, fineness=fineness), runs=2)
        surface = condense(BODY, fineness=fineness)
        fit = fit_line(build_line(press(surface, HARD, head_positions())), 48.0)
        dofs = 2 * (len(mesh.nodes) + len(mesh.rim))
        rows.append(
            {
                "fineness": fineness,
                "dofs": dofs,
                "seconds": spent,
                "amplitude": fit.amplitude,
                "sigma_mm": fit.widths_mm[0],
            }
        )
    return rows


def rectangle_mesh(x_mm: FloatArray, z_mm: FloatArray) -> Mesh:
    """A grid of quadrilaterals with corners at `x_mm` and `z_mm`, all of them fat: for bodies without a lump."""
    x, z = (np.interp(np.arange(2 * len(one) - 1) / 2, np.arange(len(one)), one) for one in (x_mm, z_mm))
    number, (n, m) = np.arange(len(x) * len(z)).reshape(len(x), -1), (len(x), len(z))
    parts = [number[i : n - 2 + i : 2, j : m - 2 + j : 2].reshape(-1) for i in range(3) for j in range(3)]
    nodes = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    none = np.zeros(len(parts[0]), dtype=bool)
    return Mesh(nodes, np.stack(parts, axis=1), none, none)


def joined(meshes: Sequence[Mesh], *, scale_mm: float) -> Mesh:
    """Merge several meshes into one; nodes nearer than 1e-8 of `scale_mm` become one."""
    offsets = np.cumsum([0] + [len(mesh.nodes) for mesh in meshes])
    points = np.concatenate([mesh.nodes for mesh in meshes])
    key = np.round(points / (1e-8 * scale_mm)).astype(np.int64)
    _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
    elements = [number.reshape(-1)[mesh.elements + offset] for mesh, offset in zip(meshes, offsets, strict=False)]
    gland, lump = (np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("gland", "lump"))
    return Mesh(points[first], np.concatenate(elements), gland, lump)


def assemble(mesh: Mesh, *, young_kpa: FloatArray, poisson: float) -> csc_array:
    """Stiffness of a whole mesh in kPa, its unknowns ``x0, z0, x1, z1, ...``, none of them held."""
    return plane_part(mesh, young_kpa, np.ones(len(mesh.elements), dtype=bool), poisson=poisson).matrix


class PlainBody:
    """The body as a grid that is as fine along the whole travel of the head as the contact needs.

    Materials are those of the elements' middles, which costs accuracy but no time: only its time is used.
    """

    def __init__(self) -> None:
        fine = np.arange(-72.0, 72.0 + CELL_MM, CELL_MM)
        far = 72.0 + np.geomspace(1.5, 210.0, 14)
        depth = np.concatenate([np.linspace(0, 24, 25), 24 + np.geomspace(1.2, 46.0, 12)])
        mesh = rectangle_mesh(np.concatenate([-far[::-1], fine, far]), depth)
        middle = mesh.nodes[mesh.elements[:, 4]]
        lump = np.hypot(middle[:, 0], middle[:, 1] - BODY.centre_mm) < BODY.radius_mm
        young = np.where(lump, 500.0, np.where(middle[:, 1] > BODY.layers.fat_mm, 50.0, 5.0))
        self.matrix = assemble(mesh, young_kpa=young, poisson=BODY.poisson)
        x, z = mesh.nodes.T
        skin = np.flatnonzero(z < 1e-9)
        self.skin = skin[np.argsort(x[skin])]
        self.x = x[self.skin]
        self.held = np.repeat((z > z.max() - 1e-6) | (np.abs(x) > x.max() - 1e-6), 2)

    def press(self, x_c: float, *, total: float) -> int:
        """Press the head at one position; the number of factorisations it took."""
        under = np.flatnonzero(np.abs(self.x - x_c) < HeadSection().half_width_mm)
        profile = HeadSection().profile_mm(self.x[under] - x_c)
        touching = np.ones(len(under), dtype=bool)
        for count in range(1, 30):
            vertical = 2 * self.skin[under[touching]] + 1
            free = ~self.held
            free[vertical] = False
            free_index = np.flatnonzero(free)
            values = np.zeros((len(free), 2))
            values[vertical, 0], values[vertical, 1] = -profile[touching], 1.0
            factor = splu(
                self.matrix[free_index][:, free_index].tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            values[free_index] = factor.solve(-(self.matrix @ values)[free_index])
            reaction = (self.matrix @ values)[vertical]
            depth = (total - reaction[:, 0].sum()) / reaction[:, 1].sum()
            force = reaction @ np.array([1.0, depth])
            sunk = values[2 * self.skin[under] + 1] @ np.array([1.0, depth])
            new = touching & (sunk - depth + profile < 1e-9)
            new[touching] = force > 0
            new |= ~touching & (sunk < depth - profile - 1e-9)
            if (new == touching).all():
                return count
            touching = new
        return count


class ReusedBody:
    """The whole body on our mesh with one factorisation for all positions of the head."""

    def __init__(self, ratio: float) -> None:
        right = body_mesh(BODY, fineness=2, layered=False)
        left = Mesh(right.nodes * [-1.0, 1.0], right.elements, right.gland, right.lump)
        mesh = joined([right, left], scale_mm=BODY.d_mm)
        young = np.where(mesh.lump, 5.0 * ratio, np.where(mesh.gland, 50.0, 5.0))
        x, z = mesh.nodes.T
        held = np.zeros((len(x), 2), dtype=bool)
        held[np.abs(x) > x.max() - 1e-6, 0] = True
        held[z > z.max() - 1e-6] = True
        free = np.flatnonzero(~held.reshape(-1))
        place = np.full(2 * len(x), -1)
        place[free] = np.arange(len(free))
        matrix = assemble(mesh, young_kpa=young, poisson=BODY.poisson)[free][:, free].tocsc()
        self.unknowns = len(free)
        self.factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        skin = np.flatnonzero(z < 1e-9)
        skin = skin[np.argsort(x[skin])]
        self.skin = place[2 * skin + 1]
        right_x = x[skin][len(skin) // 2 :]
        edges = REUSED_CELL_MM * np.arange(round(72.0 / REUSED_CELL_MM) + 1.0)
        even, odd = (skin_average(right_x, edges_mm=edges, even=even) for even in (True, False))
        # cells by nodes of the whole skin, from the averages of even and odd displacements
        n = len(right_x)
        both = np.zeros((2 * even.shape[0], 2 * n - 1))
        for average, sign in ((even, 1.0), (odd, -1.0)):
            half_matrix = np.zeros((average.shape[0], 2 * n - 1))
            half_matrix[:, n - 1 :] += 0.5 * average
            half_matrix[:, n - 1 :: -1] += 0.5 * sign * average
            both += np.concatenate([sign * half_matrix[::-1], half_matrix])
        self.average = both

    def condense(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Compliance of all cells of the skin."""
        load = np.zeros((self.unknowns, len(self.average)))
        load[self.skin] = REUSED_CELL_MM * self.average.T
        return np.asarray(self.average @ self.factor.solve(load)[self.skin])

    def press(self, x_c: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The frame at one position."""
        profile = HeadSection().cell_profile_mm(REUSED_CELL_MM)
        first = round((x_c - 12.0 + 72.0) / REUSED_CELL_MM)
        mine = self.average[first : first + len(profile)]
        load = np.zeros((self.unknowns, len(profile)))
        load[self.skin] = REUSED_CELL_MM * mine.T
        compliance = mine @ self.factor.solve(load)[self.skin]
        # there are fewer nodes than cells: without a little of their own the contact would not be settled
        compliance = 0.5 * (compliance + compliance.T) + 1e-4 * np.eye(len(mine))
        return solve_contact(FactoredCompliance.of(compliance), profile, mean_kpa=MEAN_KPA).pressure_kpa


def reused_seconds() -> dict[str, float]:
    """One position with the factorisation at hand, the factorisation, and how far the frame over the lump is off."""
    begun = time.process_time()
    body = ReusedBody(HARD)
    made = time.process_time() - begun
    places = (0.0, 10.0, 30.0)
    spent = seconds(lambda: [body.press(x) for x in places], runs=3) / len(places)
    forced = seconds(body.condense, runs=2)
    ours = press(condense(BODY, cell_mm=REUSED_CELL_MM), HARD, np.zeros(1)).pressure_kpa[0]
    off = float(np.abs(body.press(0.0) - ours).max() / MEAN_KPA)
    return {
        "factorisation_s": made,
        "position_s": spent,
        "condense_s": forced,
        "unknowns": float(body.unknowns),
        "frame_off": off,
    }


def plain_seconds() -> tuple[float, int, float]:
    """One position the plain way: seconds, unknowns, and factorisations a position."""
    body, places = PlainBody(), (0.0, 10.0, 30.0)
    counts: list[int] = []
    spent = seconds(lambda: counts.extend(body.press(x, total=MEAN_KPA * 24.0) for x in places), runs=1)
    return spent / len(places), body.matrix.shape[0], float(np.mean(counts))


def measure() -> dict[str, Any]:
    """All figures."""
    one, two = study(1), study(2)
    contact, reused = contact_seconds(), reused_seconds()
    anew, unknowns, factorisations = plain_seconds()
    positions = 150 * len(head_positions())
    by_reuse = 150 * reused["factorisation_s"] + positions * reused["position_s"]
    by_force = 150 * (reused["factorisation_s"] + reused["condense_s"]) + positions * contact
    return {
        "schema": SCHEMA,
        "load_average": os.getloadavg()[0],
        "study": one,
        "study_two_processes": two,
        "contact_us": 1e6 * contact,
        "reused": reused | {"study_s": by_reuse, "ratio": by_reuse / one["cpu_s"]},
        "by_force": {"condense_s": reused["condense_s"], "study_s": by_force, "ratio": by_force / one["cpu_s"]},
        "anew": {
            "position_s": anew,
            "unknowns": unknowns,
            "factorisations": factorisations,
            "study_s": anew * positions,
            "ratio": anew * positions / one["cpu_s"],
        },
        "growth": growth(),
    }


def main() -> None:
    """Print the figures; write them as JSON when asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.forward", description="What the study costs.")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures as JSON")
    out = parser.parse_args().json
    found = measure()
    print(f"load average {found['load_average']:.1f}")
    for name, words in (("study", "one process"), ("study_two_processes", "two processes")):
        cost = found[name]
        print(
            f"study of 150 cases, {words}: {cost['cpu_s']:.1f} s CPU, {cost['wall_s']:.1f} s wall, "
            f"peak memory at most {cost['peak_mb']:.0f} MB"
        )
    print(f"contact at one position: {found['contact_us']:.0f} us")
    for line in _peers(found):
        print(line)
    print(f"{'fineness':>8}{'unknowns':>10}{'condense, s':>13}{'a':>9}{'sigma, mm':>11}")
    for row in found["growth"]:
        print(
            f"{row['fineness']:>8}{row['dofs']:>10}{row['seconds']:>13.2f}{row['amplitude']:>9.4f}{row['sigma_mm']:>11.4f}"
        )
    if out:
        out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


def _peers(found: dict[str, Any]) -> list[str]:
    """What the other ways cost, the whole study over, and by how much that is more than ours."""
    anew, reused, forced = found["anew"], found["reused"], found["by_force"]
    return [
        f"solved anew: {1000 * anew['position_s']:.0f} ms a position ({anew['unknowns']} unknowns, "
        f"{anew['factorisations']:.1f} factorisations); the study {anew['study_s'] / 60:.0f} min, "
        f"{anew['ratio']:.0f} times ours",
        f"factorisation re-used: {1000 * reused['position_s']:.0f} ms a position ({reused['unknowns']:.0f} unknowns, "
        f"factorised once a stiffness in {reused['factorisation_s']:.2f} s; its frame is off by up to "
        f"{100 * reused['frame_off']:.0f} % of the mean); the study {reused['study_s'] / 60:.0f} min, "
        f"{reused['ratio']:.0f} times ours",
        f"condensed by force: {forced['condense_s']:.2f} s a stiffness; the study {forced['study_s'] / 60:.1f} min, "
        f"{forced['ratio']:.0f} times ours",
    ]


if __name__ == "__main__":
    main()
