"""A calibration for another head, learned and held against exams of bodies that it has not seen.

    python -m benchmarks.other_head HEAD.json DIR [--bodies BODIES.toml] [--masses 150] [--trial 25]
        [--exams 2] [--form FORM] [--trial-seed N]

By the command line it simulates the bodies (`population`) and learns a calibration (`calibrate size`); a table and maps
that DIR holds already are kept. Then it scans the trial's masses, from another seed, maps every scan and sizes it
with that calibration; at last it shows that neither this calibration nor the shipped one sizes maps of the
other's head. Both heads of record 0101 were tried with the seeds that are the defaults here.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import tactile_bayes as tb
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.instrument_json import read_simulated_head
from tactile_bayes.forward.scene import Head, Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.studies.population import BodiesFile, BodyPrior, ExamPrior, draw_mass

SEED, TRIAL_SEED = 7, 20261215


@dataclass(frozen=True, slots=True)
class Row:
    """One exam of the trial; without a size `why` says the reason."""

    true_mm: float
    median_mm: float | None = None
    low_mm: float = 0.0
    high_mm: float = 0.0
    why: str = ""


def learn(head: Path, folder: Path, *, bodies: Path | None, masses: int, form: str) -> Path:
    """Learn a calibration for the head by the command line; the path of its file."""
    table, size = folder / "population.csv", folder / f"{form}.json"
    given = ["--bodies", str(bodies)] if bodies else []
    if not table.exists():
        many = ["--masses", str(masses), "--seed", str(SEED), "--workers", "1"]
        _command("population", "--head", str(head), *given, *many, "-o", str(table))
    print(_command("calibrate", "size", str(table), "--form", form, "-o", str(size), "--force"))
    return size


def trial_scenes(
    head: Head, masses: int, exams: int, *, seed: int = TRIAL_SEED, priors: tuple[BodyPrior, ExamPrior] | None = None
) -> list[Scene]:
    """Exams of bodies that no calibration has seen, those of a mass one after the other."""
    prior, technique = priors or (BodyPrior(), ExamPrior())
    drawn = [draw_mass(i, scans=exams, seed=seed, bodies=prior, exams=technique, head=head) for i in range(masses)]
    return [scene for scenes in drawn for scene in scenes]


def trial_map(scene: Scene, path: Path) -> Path | None:
    """Scan and map one exam, unless its map is there; None where no map can be built."""
    if not path.exists():
        try:
            _map(scene).save(path)
        except TactileBayesError:
            return None
    return path


def sized(path: Path | None, true_mm: float, size: Path) -> Row:
    """Size one exam's map."""
    if path is None:
        return Row(true_mm, why="no map")
    try:
        found = tb.estimate(path, size_calibration=str(size))
    except TactileBayesError as error:
        return Row(true_mm, why=str(error))
    if found.max_size_mm is None:
        return Row(true_mm, why=found.why)
    low, high = found.max_size_mm.interval(0.95)
    return Row(true_mm, found.max_size_mm.median, low, high)


def report(rows: list[Row]) -> str:
    """Error, bias and coverage of the trial in words."""
    found = [row for row in rows if row.median_mm is not None]
    error = np.array([row.median_mm / row.true_mm - 1 for row in found if row.median_mm is not None])
    held = sum(row.low_mm <= row.true_mm <= row.high_mm for row in found)
    half = np.median([(row.high_mm - row.low_mm) / 2 / row.true_mm for row in found])
    return (
        f"{len(found)} of {len(rows)} exams sized; mean absolute error {100 * np.abs(error).mean():.1f} %, bias "
        f"{100 * error.mean():+.1f} %; {held} of {len(found)} intervals of 95 % hold the true size, half width "
        f"{100 * half:.0f} % (median)"
    )


def refusals(own: Scene, size: Path) -> list[str]:
    """What is said of this head's map with the shipped calibration, and of a default map with this calibration."""
    default = draw_mass(1, scans=1, seed=TRIAL_SEED)[0]
    said = []
    for what, scene, calibration in (("this head, solid", own, "solid"), ("default head, this", default, str(size))):
        try:
            found = tb.estimate(_map(scene), size_calibration=calibration)
            said.append(f"{what}: NOT REFUSED, {found.status}")
        except TactileBayesError as error:
            said.append(f"{what}: {error}")
    return said


def _map(scene: Scene) -> tb.Map:
    return tb.build_map(simulate(scene, rng=np.random.default_rng(scene.seed)).scan)


def _command(*arguments: str) -> str:
    done = subprocess.run([sys.executable, "-m", "tactile_bayes", *arguments], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


def main() -> None:
    """Learn, size the trial and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("head", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bodies", type=Path)
    parser.add_argument("--masses", type=int, default=150)
    parser.add_argument("--trial", type=int, default=25)
    parser.add_argument("--exams", type=int, default=2)
    parser.add_argument("--form", default="eq6-residual")
    parser.add_argument("--trial-seed", type=int, default=TRIAL_SEED)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    size = learn(given.head, given.folder, bodies=given.bodies, masses=given.masses, form=given.form)
    found = read_record(given.bodies, BodiesFile) if given.bodies else None
    priors = found and (found.bodies, found.exams)
    scenes = trial_scenes(
        read_simulated_head(given.head), given.trial, given.exams, seed=given.trial_seed, priors=priors
    )
    rows = []
    for i, scene in enumerate(scenes):
        path = trial_map(scene, given.folder / f"trial-{i // given.exams + 1}-{i % given.exams + 1}.nc")
        rows.append(row := sized(path, scene.solid_lumps[0].d_mm, size))
        words = row.why or f"{row.median_mm:.1f} ({row.low_mm:.1f} to {row.high_mm:.1f})"
        print(f"mass {i // given.exams + 1} exam {i % given.exams + 1}: true {row.true_mm:.1f}, {words}", flush=True)
    print(report(rows))
    print("\n".join(refusals(scenes[0], size)))


if __name__ == "__main__":
    main()
