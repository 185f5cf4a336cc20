"""What the frames of an exam tell of a lump's size beside the map's bump and the head's profile.

``python -m benchmarks.information [FOLDER]`` prints the table of docs/decisions/0104: left-out errors of ln size,
ln stiffness or seat by a regression on ln amplitude, both widths and the head's profile, and what each candidate takes
off them, with the standard error over bodies and with the candidate's figures given to other bodies as a control.
``bound`` as the folder prints instead how well frames could tell them if the simulation were the truth.

FOLDER holds for each body ``N.json``, rows of `MassRow`, and for each of its exams ``N_E.pkl``, the zlib-compressed
pickle of its scene and scan. Without one, `--masses` bodies are simulated: too few for a sound figure, enough to see it
run.
"""

from __future__ import annotations

import argparse
import json
import pickle
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.information_bound import PROPERTIES, differentiate, posterior_sd
from benchmarks.information_features import contact_figures, depth_figures, frame_figures, hermite_figures
from benchmarks.information_frames import HeadFrames, fit_bump, fixed_bump
from benchmarks.information_gp import Exams, left_out
from benchmarks.information_parts import part_figures
from tactile_bayes.forward.population import draw_mass
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.mapping.build import build_map
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.scan import Scan
from tactile_bayes.studies.population import MassRow, measure_exam

NORMALISE = "gain"
WINSOR_SD = 4.0
"""Figures further from the median, in robust SDs, are moved to there."""
ROWS = (
    "rows_middle_amplitude",
    "rows_middle_sigma_x",
    "rows_middle_sigma_y",
    "rows_outer_amplitude",
    "rows_outer_sigma_x",
    "rows_outer_sigma_y",
    "rows_apart_x",
)
CANDIDATES: Mapping[str, Sequence[str]] = {
    "mean pressure": ("mean_kpa",),
    "bump against pressure": ("amplitude_pressure", "profile_pressure"),
    "sinking per kPa": ("sinks_mm_per_kpa",),
    "lift over the lump": ("lift_wide", "lift_narrow"),
    "border and corners away from the lump": ("border", "corner"),
    "border and corners over the lump": ("border_over", "corner_over"),
    "Gauss-Hermite on the map": ("h40", "h04", "h22"),
    "ring and peak on the map": ("ring", "peak"),
    "amplitude by place": ("amplitude_middle", "amplitude_across", "amplitude_along"),
    "bumps of the rows apart": ("rows_apart_x",),
    "bumps of the rows and of the columns apart": ("rows_apart_x", "columns_apart_y"),
    "bumps from thirds of the rows": ROWS,
    "bumps from thirds of the rows, columns apart": (*ROWS, "columns_apart_y"),
}
ORACLES = ("mean_kpa", "fat_kpa", "gland_ratio", "thickness_mm", "stiffness_ratio", "seat")
CASES: Mapping[str, Mapping[str, Any]] = {
    "frames and depth": {},
    "depth only": {"frames": False},
    "model off by 3 %": {"model_share": 0.03, "gain_share": 0.03},
    "model off by 10 %": {"model_share": 0.1, "gain_share": 0.05},
}


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Exams with all their figures.

    Parameters
    ----------
    row
        True properties and the usual measurements.
    figures
        By name.
    """

    row: MassRow
    figures: Mapping[str, float]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", help="exams of bodies, or 'bound'; default: simulate some")
    parser.add_argument(
        "--masses", type=int, default=40, help="bodies simulated without a folder, or at most used of it"
    )
    parser.add_argument("--seed", type=int, default=7, help="of simulated bodies")
    parser.add_argument("--cache", type=Path, help="file that keeps the figures of the exams")
    parser.add_argument("--target", default="d_mm", choices=("d_mm", "stiffness_ratio", "seat"))
    parser.add_argument("--only", action="append", choices=sorted(CANDIDATES), help="a candidate; may be repeated")
    options = parser.parse_args()
    if options.folder == "bound":
        print_bound(options.masses, options.seed)
        return
    exams = _cached(options)
    print_table(exams, options.target, options.only or list(CANDIDATES))


def _cached(options: argparse.Namespace) -> list[Measured]:
    if options.cache is not None and options.cache.exists():
        kept: list[Measured] = pickle.loads(options.cache.read_bytes())
        return kept
    source = _simulated(options) if options.folder is None else _stored(Path(options.folder), options.masses)
    exams = [Measured(row, found) for row, scene, scan in source if (found := measure(row, scene, scan)) is not None]
    if options.cache is not None:
        options.cache.write_bytes(pickle.dumps(exams))
    return exams


def _simulated(options: argparse.Namespace) -> Iterator[tuple[MassRow, Scene, Scan]]:
    for body in range(options.masses):
        for exam, scene in enumerate(draw_mass(body, scans=2, seed=options.seed)):
            scan = simulate(scene, rng=np.random.default_rng(scene.seed)).scan
            yield measure_exam(scene, scan, body=body, exam=exam, normalise=NORMALISE), scene, scan


def _stored(folder: Path, most: int) -> Iterator[tuple[MassRow, Scene, Scan]]:
    bodies = sorted(int(path.stem) for path in folder.glob("*.json"))
    for body in np.random.default_rng(0).permutation(bodies)[:most]:
        rows = [MassRow(**row) for row in json.loads((folder / f"{body}.json").read_text())]
        for row in rows:
            if row.normalise == NORMALISE:
                packed = (folder / f"{body}_{row.exam}.pkl").read_bytes()
                yield row, *pickle.loads(zlib.decompress(packed))


def measure(row: MassRow, scene: Scene, scan: Scan) -> dict[str, float] | None:
    """All figures of one exam; None where no lump, no profile of the head or no frames with the lump were measured."""
    if not row.detected or row.head_profile_x2 is None:
        return None
    assert row.amplitude is not None
    assert row.sigma_x_mm is not None
    assert row.sigma_y_mm is not None
    assert row.mean_kpa is not None
    lump, widths = scene.solid_lumps[0], (row.sigma_x_mm, row.sigma_y_mm)
    tactile_map = build_map(scan, normalise=NORMALISE)
    assert tactile_map.plane_from_base is not None
    # where the search begins; the fitted place is used
    base = apply(scene.tracker.base_from_plane(), np.array([lump.x_mm, lump.y_mm, 0.0]))
    near = apply(tactile_map.plane_from_base, base)[:2]
    free, cells = fit_bump(tactile_map, near, widths, row.amplitude)
    bump = fixed_bump(tactile_map, near, widths, row.amplitude)
    frames = HeadFrames.of(scan, tactile_map.plane_from_base, bump)
    return {
        "mean_kpa": row.mean_kpa,
        **hermite_figures(free, cells),
        **frame_figures(frames, bump),
        **contact_figures(frames),
        **depth_figures(frames),
        **part_figures(frames, bump),
    }


def print_table(exams: Sequence[Measured], target: str, names: Sequence[str]) -> None:
    """Print what each candidate and each true property takes off the error of the target."""
    exams = [exam for exam in exams if all(np.isfinite(value) for value in exam.figures.values())]
    bodies, body = np.unique([exam.row.body for exam in exams], return_inverse=True)
    first = np.unique(body, return_index=True)[1]
    truth = np.array([getattr(exam.row, target) for exam in exams], dtype=np.float64)[first]
    study = _Study(body, truth if target == "seat" else np.log(truth), base_features(exams), target)
    print(f"{len(bodies)} bodies, {len(exams)} exams; left-out error of {target}: {study.describe(study.base_error)}\n")
    print("| added | MAE | taken off | permuted |\n|---|---|---|---|")
    for name in names:
        study.row(name, columns(exams, CANDIDATES[name]))
    for name in ORACLES:
        values = np.array([getattr(exam.row, name) for exam in exams], dtype=np.float64)
        study.row(f"true {name}", values[:, None] if name == "seat" else np.log(values)[:, None])


def base_features(exams: Sequence[Measured]) -> FloatArray:
    """(n, 6) ln amplitude, mean log width, half log axis ratio, head profile."""
    rows = [exam.row for exam in exams]
    sigma = np.log(np.array([[row.sigma_x_mm, row.sigma_y_mm] for row in rows], dtype=np.float64))
    profile = np.array([[getattr(row, name) for name in HEAD_PROFILE] for row in rows], dtype=np.float64)
    amplitude = np.log(np.array([row.amplitude for row in rows], dtype=np.float64))
    found: FloatArray = np.c_[amplitude, sigma.mean(axis=1), (sigma[:, 0] - sigma[:, 1]) / 2, profile]
    return found


def columns(exams: Sequence[Measured], names: Sequence[str]) -> FloatArray:
    """(n, k) figures, outliers moved inwards."""
    values = np.array([[exam.figures[name] for name in names] for exam in exams])
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
    width = WINSOR_SD * (high - low) / 1.35
    return np.asarray(np.clip(values, middle - width, middle + width))


class _Study:
    """Left-out errors with and without a candidate."""

    def __init__(self, body: np.ndarray[Any, Any], truth: FloatArray, base: FloatArray, target: str) -> None:
        self.body, self.truth, self.base, self.target = body, truth, base, target
        error, _, self.theta = left_out(Exams(base, body), truth)
        self.base_error = self._size(error)

    def _size(self, error: FloatArray) -> FloatArray:
        """Absolute errors: of a size in per cent of it."""
        return np.asarray(100 * np.abs(np.expm1(error)) if self.target == "d_mm" else np.abs(error))

    def describe(self, error: FloatArray) -> str:
        return f"{error.mean():.2f} %" if self.target == "d_mm" else f"{error.mean():.3f}"

    def _with(self, added: FloatArray) -> FloatArray:
        k, more = self.base.shape[1], added.shape[1]
        start = np.r_[self.theta[:k], np.full(more, np.log(6.0)), self.theta[k:]]
        return self._size(left_out(Exams(np.c_[self.base, added], self.body), self.truth, start=start)[0])

    def row(self, name: str, added: FloatArray) -> None:
        """Print one row."""
        error = self._with(added)
        other = np.random.default_rng(0).permutation(len(self.truth))
        first = np.unique(self.body, return_index=True)[1]
        control = self._with(added[first[other[self.body]]])
        print(
            f"| {name} ({added.shape[1]}) | {self.describe(error)} | {self._gain(error)} | {self._gain(control)} |",
            flush=True,
        )

    def _gain(self, error: FloatArray) -> str:
        gain = self.base_error - error
        digits = 2 if self.target == "d_mm" else 3
        return f"{gain.mean():+.{digits}f} ± {gain.std() / np.sqrt(len(gain)):.{digits}f}"


def print_bound(bodies: int, seed: int) -> None:
    """Print the SD that one exam's frames could leave of each property, by how far the model is off."""
    found: dict[str, list[FloatArray]] = {name: [] for name in CASES}
    for body in range(bodies):
        exam = differentiate(draw_mass(body, scans=1, seed=seed)[0])
        for name, case in CASES.items():
            found[name].append(posterior_sd([exam], **case))
    print(f"Median of {bodies} bodies\n\n| | {' | '.join(PROPERTIES)} |\n|---|{'---|' * len(PROPERTIES)}")
    for name, values in found.items():
        print(f"| {name} | {' | '.join(f'{value:.4f}' for value in np.median(values, axis=0))} |")


if __name__ == "__main__":
    main()
