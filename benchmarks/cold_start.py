"""Every command on the embedded data, from a cold process to its last byte, and the peers it is held against."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

DEMO = Path(__file__).resolve().parent.parent / "tactile_bayes" / "demo"

# What any Python program, any numerical one and any sampler pays before it begins.
PEERS: dict[str, tuple[str, ...]] = {
    "python": ("-c", "pass"),
    "numpy": ("-c", "import numpy"),
    "emcee and arviz": ("-c", "import emcee, arviz"),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One command line.

    Parameters
    ----------
    name
        What ``--only`` calls it.
    words
        After ``tactile-bayes``; run in a folder of its own.
    peer
        Key of `PEERS`.
    needs
        Names of the cases that make its inputs.
    """

    name: str
    words: tuple[str, ...]
    peer: str
    needs: tuple[str, ...] = ()

    @property
    def arguments(self) -> tuple[str, ...]:
        """For the Python interpreter."""
        return ("-m", "tactile_bayes", *self.words)


def _estimate(method: str, peer: str) -> Case:
    words = ("estimate", "map.nc", "--size-calibration", "size.json", "--method", method, "--json")
    return Case(f"estimate-{method}", words, peer, ("map", "calibrate-size"))


CASES: tuple[Case, ...] = (
    Case("help", ("--help",), "python"),
    Case("import", ("import", str(DEMO / "scan.mcap"), "-o", "again.mcap", "--force"), "numpy"),
    Case("simulate", ("simulate", str(DEMO / "scene.toml"), "-o", "scan.mcap", "--force"), "numpy"),
    # as the table of phantoms has it
    Case("map", ("map", str(DEMO / "scan.mcap"), "-o", "map.nc", "--normalise", "mean", "--force"), "numpy"),
    Case(
        "calibrate-size",
        ("calibrate", "size", str(DEMO / "phantoms.csv"), "-o", "size.json", "--force"),
        "emcee and arviz",
    ),
    _estimate("optimise", "numpy"),
    _estimate("laplace", "numpy"),
    _estimate("importance", "numpy"),
    _estimate("ensemble", "emcee and arviz"),
    Case("plan", ("plan", "--patients", "24", "--maps", "3", "--trials", "50"), "numpy"),
    Case("validate", ("validate", str(DEMO / "trial.csv"), "--excision", str(DEMO / "excision.csv")), "numpy"),
    Case("show", ("show", "map.nc"), "numpy", ("map",)),
    Case("check", ("check", str(DEMO / "scan.mcap")), "numpy"),
    Case("demo", ("demo", "-o", "demo", "--force"), "emcee and arviz"),
)

# Commands that a cold start says nothing about, and where they are measured instead.
MEASURED_ELSEWHERE = {
    "study": "benchmarks.forward: minutes of work",
    "tables": "benchmarks.forward: minutes of work",
    "head": "benchmarks.forward's model: `head design` is 2 s of work",
    "campaign": "its steps are `map` and `estimate`, in processes that are warm",
    "compare-model": "it solves the scan's frames anew: seconds of work",
    "report": "its maps' estimates, measured here as `estimate`, are the cost",
    "export": "the packages of its extras are the cost",
    "compare": "it needs two visits; its maps' estimates, measured here as `estimate`, are the cost",
    "diagnose": "it needs a posterior that `estimate` wrote; the chains are the cost",
    "tradeoff": "it measures itself: a minute of work",
    "population": "hours of work; see validation.own_trial for a scan's",
    "sbc": "it measures itself: its report tells maps per second",
    "record": "tests/endurance/recording.py: runs until it is stopped",
    "repair": "tests/endurance/recording.py: needs a recording that was cut off",
    "replay": "tests/endurance/recording.py: runs in real time",
    "emulate": "tests/endurance/recording.py: runs until it is stopped",
    "devices": "tests/endurance/recording.py: depends on the machine's ports",
}
