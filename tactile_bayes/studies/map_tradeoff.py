"""Cost of accuracy before the map: cells, frames, time of strokes and normalising, each up to the size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.mapping import build_map
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.mapping.thinning import first_seconds
from tactile_bayes.posterior.options import EstimateOptions
from tactile_bayes.presets import CELL_MM, DEFAULT_NORMALISE, NORMALISE
from tactile_bayes.scan import Scan
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.studies.cost_ladder import Ladder, Reference, Run, Work, climbed, default_run
from tactile_bayes.studies.estimate_tradeoff import Estimator
from tactile_bayes.studies.size_answers import SizeAnswer

FINEST_CELL_MM = 0.5
CELLS_MM = (FINEST_CELL_MM, 0.75, 1.5, 2.0, 3.0, 4.0)
EVERY = (2, 4, 8, 16, 32)
SHARES_OF_TIME = (0.75, 0.5, 0.25)
CELL, FRAMES, TIME, LEVEL = "cell size", "frames used", "time of strokes", "normalising"
Inputs = Callable[[TactileMap], tuple[Calibration | None, EstimateOptions]]


@dataclass(frozen=True, slots=True)
class MapSetting:
    """One way to build a map.

    Parameters
    ----------
    axis, label, default, usable
        As of `Priced`.
    options
        Of `build_map`.
    duration_s
        Use the first so many seconds only; None uses all.
    weight
        About how many times the default's CPU time it takes, for a forecast.
    """

    axis: str
    label: str
    options: dict[str, Any] = field(default_factory=dict)
    duration_s: float | None = None
    weight: float = 1.0
    default: bool = False
    usable: bool = True


def settings_of(scan: Scan) -> list[MapSetting]:
    """Everything that is tried, the default first."""
    time_s = scan.frames.time_s
    whole_s = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    return [
        MapSetting(CELL, f"--cell-mm {CELL_MM:g}", default=True),
        *(MapSetting(CELL, f"--cell-mm {h:g}", {"cell_mm": h}, weight=0.5 + 0.5 / h**2) for h in CELLS_MM),
        *(MapSetting(FRAMES, f"--every {n}", {"every": n}, weight=0.5 + 0.5 / n) for n in EVERY),
        *(
            MapSetting(TIME, f"the first {share * whole_s:.3g} s of {whole_s:.3g} s", {}, share * whole_s, usable=False)
            for share in SHARES_OF_TIME
            if whole_s > 0
        ),
        *(
            MapSetting(LEVEL, f"--normalise {way}", {"normalise": way}, usable=False)
            for way in NORMALISE
            if way != DEFAULT_NORMALISE
        ),
    ]


def measure(scan: Scan, *, inputs: Inputs, work: Work) -> Ladder:
    """Build and estimate the map of a scan at every setting.

    Parameters
    ----------
    inputs
        From a map to the calibration and the options with which `estimate` takes it by itself.

    Raises
    ------
    BadDataError
        When no map can be built by default.
    """
    clock = work.clock

    def run_of(one: MapSetting) -> Run:
        def once(number: int) -> tuple[dict[str, float], SizeAnswer]:
            begun = clock()
            try:
                tactile_map = _build(scan, one)
                built_s = clock() - begun
                calibration, options = inputs(tactile_map)
                estimator = Estimator(tactile_map, calibration, work.seed, clock, work.probability)
                seconds, answer = estimator.run(options)(number)
            except BadDataError as error:
                if one.default:
                    raise
                return {"map": clock() - begun, "estimate": 0.0}, SizeAnswer(str(error))
            return {"map": built_s, **seconds}, answer

        return once

    settings = settings_of(scan)
    seconds, _ = default_run(run_of(settings[0]))
    return climbed(settings, run_of, lambda: _reference(scan, inputs, work), default_s=seconds, work=work)


def _build(scan: Scan, one: MapSetting) -> TactileMap:
    used = scan if one.duration_s is None else first_seconds(scan, one.duration_s)
    return build_map(used, **one.options)


def _reference(scan: Scan, inputs: Inputs, work: Work) -> Reference:
    """A long run on the map with the finest cells, of all frames."""
    begun = work.clock()
    finest = build_map(scan, cell_mm=FINEST_CELL_MM)
    calibration, options = inputs(finest)
    found = Estimator(finest, calibration, work.seed, work.clock, work.probability).reference(options)
    words = found.words.replace("the default's posterior", f"the map of all frames in cells of {FINEST_CELL_MM:g} mm")
    return replace(found, words=words, cpu_s=work.clock() - begun)
