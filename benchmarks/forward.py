"""What the plane-strain study costs: ``python -m benchmarks.forward [--json OUT]``.

The whole study on one process and on two, a contact problem, how condensing grows with the mesh, and all that against
the plain way: at each position of the head, solve the whole body with the touching part of its skin held, until what
touches no longer changes. Seconds of the wall; run it on a quiet machine, with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse.linalg import splu

from tactile_bayes.batch import open_executor
from tactile_bayes.commands.study import fit_line, run_study
from tactile_bayes.forward.body import Body
from tactile_bayes.forward.condense import condense
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.mesh import body_mesh, disc_mesh, rectangle_mesh
from tactile_bayes.forward.plane_strain import assemble
from tactile_bayes.forward.study import StudySettings, paper_grid
from tactile_bayes.forward.tactile_line import MEAN_KPA, build_line, head_positions, press

SCHEMA = "tactile-bayes/benchmark-forward/1"
BODY = Body(15.0, 1.0)
HARD = 100.0
CELL_MM = 1.0


def seconds(work: Callable[[], object], *, runs: int = 3) -> float:
    """The least CPU time of a few runs."""
    times = []
    for _ in range(runs):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


def study(workers: int) -> None:
    """The 150 cases, cold processes included."""
    with open_executor(workers=workers) as executor:
        run_study(paper_grid(0.0), settings=StudySettings(), executor=executor)


def study_seconds() -> dict[str, float]:
    """The study on one process and on two."""
    begun = time.perf_counter()
    cpu = seconds(lambda: study(1), runs=1)
    middle = time.perf_counter()
    study(2)
    end = time.perf_counter()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6
    return {"cpu_s": cpu, "wall_s": middle - begun, "wall_two_processes_s": end - middle, "peak_mb": peak}


def contact_seconds() -> float:
    """One position of the head, among the 241 of a map."""
    surface, positions = condense(BODY), head_positions()
    return seconds(lambda: press(surface, HARD, positions)) / len(positions)


def growth() -> list[dict[str, float]]:
    """Condensing at several finenesses, with the figures that the map then has."""
    rows = []
    for fineness in (1, 2, 3, 4, 6):
        meshes = [body_mesh(BODY, fineness=fineness), disc_mesh(BODY, fineness=fineness, layered=True)]
        spent = seconds(lambda fineness=fineness: condense(BODY, fineness=fineness), runs=2)
        surface = condense(BODY, fineness=fineness)
        fit = fit_line(build_line(press(surface, HARD, head_positions())), 48.0)
        dofs = 2 * sum(len(mesh.nodes) for mesh in meshes)
        rows.append(
            {"fineness": fineness, "dofs": dofs, "seconds": spent, "amplitude": fit.amplitude, "sigma_mm": fit.sigma_mm}
        )
    return rows


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
        under = np.flatnonzero(np.abs(self.x - x_c) < Head().half_width_mm)
        profile = Head().profile_mm(self.x[under] - x_c)
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


def plain_seconds() -> tuple[float, int, float]:
    """One position the plain way: seconds, unknowns, and factorisations a position."""
    body, places = PlainBody(), (0.0, 10.0, 30.0)
    counts: list[int] = []
    spent = seconds(lambda: counts.extend(body.press(x, total=MEAN_KPA * 24.0) for x in places), runs=1)
    return spent / len(places), body.matrix.shape[0], float(np.mean(counts))


def measure() -> dict[str, Any]:
    """All figures."""
    study_costs = study_seconds()
    contact = contact_seconds()
    plain, unknowns, factorisations = plain_seconds()
    positions = 150 * len(head_positions())
    return {
        "schema": SCHEMA,
        "load_average": os.getloadavg()[0],
        "study": study_costs,
        "contact_us": 1e6 * contact,
        "plain_position_s": plain,
        "plain_unknowns": unknowns,
        "plain_factorisations": factorisations,
        "ratio_a_position": plain * positions / study_costs["cpu_s"],
        "growth": growth(),
    }


def main() -> None:
    """Print the figures; write them as JSON when asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.forward", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures as JSON")
    out = parser.parse_args().json
    found = measure()
    costs = found["study"]
    print(
        f"study of 150 cases: {costs['cpu_s']:.1f} s CPU, {costs['wall_s']:.1f} s on the wall, on two processes "
        f"{costs['wall_two_processes_s']:.1f} s (load average {found['load_average']:.1f}); "
        f"peak {costs['peak_mb']:.0f} MB"
    )
    print(f"contact at one position: {found['contact_us']:.0f} us")
    print(
        f"the plain way: {found['plain_position_s']:.2f} s a position ({found['plain_unknowns']} unknowns, "
        f"{found['plain_factorisations']:.1f} factorisations); the study, all in, is "
        f"{found['ratio_a_position']:.0f} times cheaper a position"
    )
    print(f"{'fineness':>8}{'unknowns':>10}{'condense, s':>13}{'a':>9}{'sigma, mm':>11}")
    for row in found["growth"]:
        print(
            f"{row['fineness']:>8}{row['dofs']:>10}{row['seconds']:>13.2f}{row['amplitude']:>9.4f}{row['sigma_mm']:>11.4f}"
        )
    if out:
        out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
