"""A calibration for another head, learned and held against exams of bodies that it has not seen.

    python -m validation other_head HEAD.json DIR [--bodies BODIES.toml] [--masses 150] [--trial 25]
        [--exams 2] [--form FORM] [--trial-seed N]

By the command line it simulates the bodies (`population`) and learns a calibration (`calibrate size`); a table and maps
that DIR holds already are kept. Then it scans the trial's masses, from another seed, maps every scan and sizes it
with that calibration; at last it shows that neither this calibration nor the shipped one sizes maps of the
other's head. Both heads of record 0101 were tried with the seeds that are the defaults here.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tactile_bayes as tb
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.instrument import read_simulated_head
from tactile_bayes.forward.scene import Head, Scene
from tactile_bayes.studies.population import BodiesFile, BodyPrior, ExamPrior, Population
from validation.common import errors_of, parser, run, scan_of

SEED, TRIAL_SEED = 7, 20261215


def learn(head: Path, folder: Path, *, bodies: Path | None, masses: int, form: str) -> Path:
    """Learn a calibration for the head by the command line; the path of its file."""
    table, size = folder / "population.csv", folder / f"{form}.json"
    given = ["--bodies", str(bodies)] if bodies else []
    if not table.exists():
        many = ["--masses", str(masses), "--seed", str(SEED), "--workers", "1"]
        run("population", "--head", str(head), *given, *many, "-o", str(table))
    print(run("calibrate", "size", table, "--form", form, "-o", size, "--force"))
    return size


def trial_scenes(
    head: Head, masses: int, exams: int, *, seed: int = TRIAL_SEED, priors: tuple[BodyPrior, ExamPrior] | None = None
) -> list[Scene]:
    """Exams of bodies that no calibration has seen, those of a mass one after the other."""
    prior, technique = priors or (BodyPrior(), ExamPrior())
    drawn = [
        Population(scans=exams, seed=seed, bodies=prior, exams=technique, head=head).scenes(i) for i in range(masses)
    ]
    return [scene for scenes in drawn for scene in scenes]


def trial_map(scene: Scene, path: Path) -> Path | None:
    """Scan and map one exam, unless its map is there; None where no map can be built."""
    if not path.exists():
        try:
            tb.build_map(scan_of(scene)).save(path)
        except TactileBayesError:
            return None
    return path


def sized(path: Path | None, size: Path) -> tuple[float, float, float] | str:
    """Median and interval of one exam's map, or why there is none."""
    if path is None:
        return "no map"
    try:
        found = tb.estimate(path, size_calibration=str(size))
    except TactileBayesError as error:
        return str(error)
    return found.why if found.max_size_mm is None else (found.max_size_mm.median, *found.max_size_mm.interval(0.95))


def refusals(own: Scene, size: Path) -> list[str]:
    """What is said of this head's map with the shipped calibration, and of a default map with this calibration."""
    default = Population(scans=1, seed=TRIAL_SEED).scenes(1)[0]
    said = []
    for what, scene, calibration in (("this head, solid", own, "solid"), ("default head, this", default, str(size))):
        try:
            found = tb.estimate(tb.build_map(scan_of(scene)), size_calibration=calibration)
            said.append(f"{what}: NOT REFUSED, {found.status}")
        except TactileBayesError as error:
            said.append(f"{what}: {error}")
    return said


def main(arguments: Sequence[str] | None = None) -> None:
    """Learn, size the trial and print what came of it."""
    words = parser(__name__, __doc__)
    words.add_argument("head", type=Path)
    words.add_argument("folder", type=Path)
    words.add_argument("--bodies", type=Path)
    words.add_argument("--masses", type=int, default=150)
    words.add_argument("--trial", type=int, default=25)
    words.add_argument("--exams", type=int, default=2)
    words.add_argument("--form", default="eq6-residual")
    words.add_argument("--trial-seed", type=int, default=TRIAL_SEED)
    given = words.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    size = learn(given.head, given.folder, bodies=given.bodies, masses=given.masses, form=given.form)
    bodies = read_record(given.bodies, BodiesFile) if given.bodies else None
    priors = bodies and (bodies.bodies, bodies.exams)
    scenes = trial_scenes(
        read_simulated_head(given.head), given.trial, given.exams, seed=given.trial_seed, priors=priors
    )
    rows = []
    for i, scene in enumerate(scenes):
        path = trial_map(scene, given.folder / f"trial-{i // given.exams + 1}-{i % given.exams + 1}.nc")
        found, true = sized(path, size), scene.solid_lumps[0].d_mm
        told = found if isinstance(found, str) else f"{found[0]:.1f} ({found[1]:.1f} to {found[2]:.1f})"
        rows += [] if isinstance(found, str) else [(true, *found)]
        print(f"mass {i // given.exams + 1} exam {i % given.exams + 1}: true {true:.1f}, {told}", flush=True)
    print(f"{len(scenes)} exams: {errors_of(rows)}")
    print("\n".join(refusals(scenes[0], size)))
