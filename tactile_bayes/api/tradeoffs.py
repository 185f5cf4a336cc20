"""The trade of time for accuracy on a user's own maps and scans: calibration and options as `estimate` takes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_bayes.api.estimating import estimate_file, estimate_inputs
from tactile_bayes.api.pooled import pool_estimates
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.map_nc import read_map
from tactile_bayes.studies.estimate_tradeoff import PooledRow, measure
from tactile_bayes.studies.size_answers import SIZE, SizeAnswer
from tactile_bayes.studies.tradeoffs import measure_map

if TYPE_CHECKING:
    from tactile_bayes.mapping.map import TactileMap
    from tactile_bayes.posterior.options import EstimateOptions
    from tactile_bayes.scan import Scan
    from tactile_bayes.size.pooling import Calibration, PooledEstimate
    from tactile_bayes.studies.estimate_tradeoff import Clock, Ladder, Work


def tradeoff_of_map(path: Path, settings: Settings, work: Work) -> tuple[TactileMap, Ladder]:
    """Every setting of `estimate` on a map that need not be built again; the map too."""
    _refuse_checkpoint(settings)
    tactile_map = read_map(path)
    try:
        calibration, options, _ = estimate_inputs(settings, tactile_map)
        return tactile_map, measure(tactile_map, calibration=calibration, options=options, work=_of(settings, work))
    except BadDataError as error:
        raise error.at(path) from None


def pooled_rows(paths: Sequence[Path], settings: Settings, *, clock: Clock) -> tuple[PooledRow, ...]:
    """The size by the first map of one mass, by the first two, and so on."""

    rows, found, spent = [], list[SizeEstimate](), 0.0
    for number, path in enumerate(paths, start=1):
        begun = clock()
        found.append(estimate_file(path, settings))
        assert found[-1].answer.report is not None  # made here: its time is the estimate's, not the pooling's
        spent += clock() - begun
        begun = clock()
        together = pool_estimates(found, settings, names=[one.stem for one in paths[:number]], inputs={})
        found = list(together.maps)
        pooling = clock() - begun
        rows.append(PooledRow(number, spent + pooling, *_pooled_answer(together.pooled, settings)))
    return tuple(rows)


def _pooled_answer(pooled: PooledEstimate, settings: Settings) -> tuple[SizeAnswer, float]:
    """The size of this exam, and half the width of the interval of another one."""
    if pooled.size is None:
        return SizeAnswer(pooled.reason), float("nan")
    found = {SIZE: pooled.size.summarise(SIZE, probability=settings.interval)}
    answer = SizeAnswer("", None, found, settings.method, pooled.size.variance_share)
    if pooled.size.another_exam is None:
        return answer, float("nan")
    another = pooled.size.another_exam.summarise(SIZE, probability=settings.interval)
    return answer, 0.5 * (another.high - another.low)


def tradeoff_of_scan(scan: Scan, settings: Settings, work: Work) -> Ladder:
    """Every setting of `map` on a scan, each with an estimate by default of the map that it makes."""
    _refuse_checkpoint(settings)

    def inputs(tactile_map: TactileMap) -> tuple[Calibration | None, EstimateOptions]:
        calibration, options, _ = estimate_inputs(settings, tactile_map)
        return calibration, options

    return measure_map(scan, inputs=inputs, work=_of(settings, work))


def _of(settings: Settings, work: Work) -> Work:
    """The work with the settings' seed and interval."""
    return replace(work, seed=settings.seed, probability=settings.interval)


def _refuse_checkpoint(settings: Settings) -> None:
    if settings.checkpoint is not None:
        raise UsageError("a checkpoint is of one estimate, and this command makes many; leave checkpoint out")
