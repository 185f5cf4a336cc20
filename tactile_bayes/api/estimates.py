"""Estimates from Python: `estimate` and `pool`, with their keywords."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.arguments import path_of, plain, sequence_of, takes
from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.maps import Map, map_of
from tactile_bayes.api.pooled import PooledSize, pool_estimates
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError, check_number
from tactile_bayes.files.size_json import read_repeatability


def settings_of(options: Mapping[str, Any]) -> Settings:
    """Make settings from keywords; the defaults are the command line's."""
    given = {name: plain(value) for name, value in options.items()}
    calibration, repeatability = given.get("size_calibration"), given.get("repeatability")
    if not (calibration is None or isinstance(calibration, str) or hasattr(calibration, "recipe")):
        given["size_calibration"] = str(path_of(calibration))
    if "known" in given:
        given["known"] = _properties(given["known"])
    if not (repeatability is None or hasattr(repeatability, "between_maps")):
        given["repeatability"] = read_repeatability(path_of(repeatability))
    if "checkpoint" in given:
        given["checkpoint"] = path_of(given["checkpoint"])
    if isinstance(given.get("centre_mm"), Sequence | np.ndarray) and not isinstance(given["centre_mm"], str):
        given["centre_mm"] = tuple(plain(one) for one in given["centre_mm"])
    return Settings(**given)


def _properties(given: Any) -> tuple[tuple[str, float], ...]:
    """Known properties of a body from a mapping, or from pairs."""
    pairs = list(given.items()) if isinstance(given, Mapping) else given
    if isinstance(pairs, str) or not isinstance(pairs, Sequence) or any(np.shape(one) != (2,) for one in pairs):
        raise UsageError(f'known is {given!r}; give a mapping such as {{"seat": 1.2}}')
    for name, value in pairs:
        check_number(f"known {name}", value)
    return tuple((str(name), plain(value)) for name, value in pairs)


@takes(Settings, without=["settings_file"])
def estimate(tactile_map: Any, *, progress: Callable[[int, int], None] | None = None, **settings: Any) -> SizeEstimate:
    """Estimate a lump's size from one map.

    Parameters
    ----------
    tactile_map
        A map, or the path of one.
    progress
        Called with effective draws done and wanted.
    **settings
        As of `tactile_bayes.api.settings.Settings`, by default as on the command line; `size_calibration` is a
        name, a path or a calibration from `calibrate_size`, `known` a mapping such as ``{"seat": 1.2}``,
        `repeatability` a path or what `calibrate_repeatability` returns.

    Returns
    -------
    SizeEstimate
        Without a number where the map shows no lump that can be measured: `why` says the reason.

    Raises
    ------
    BadDataError
        When a file is not what it must be, or the calibration does not fit the map.
    UsageError
        When settings contradict each other, or a value cannot be one.
    NotConvergedError
        When the method asked for does not converge.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> found = tb.estimate(tb.demo_map())
    >>> low, high = found.max_size_mm.interval(0.9)
    >>> bool(low < 15.0 < high)
    True
    """
    given = map_of(tactile_map)
    inputs, used = {"map": given.path}, settings_of(settings)
    found = estimate_one(given.tactile_map, used, inputs=inputs, scans=given.scans, progress=progress)
    return replace(found, name="" if given.path is None else given.path.stem)


@takes(Settings, without=["settings_file"])
def pool(maps: Iterable[Any], **settings: Any) -> PooledSize:
    """Estimate one size from several maps of one mass, whose spread is learned.

    Parameters
    ----------
    maps
        Maps, paths or estimates; each map once, in any order.
    **settings
        As of `estimate`; estimates that are given keep their own.

    Raises
    ------
    UsageError
        When there is no map, one is given twice, or the calibration cannot pool.
    BadDataError
        As of `estimate`, and when the maps were normalised in several ways.
    """
    used = settings_of(settings)
    refuse_checkpoint(used)
    if isinstance(maps, str | Path | Map | SizeEstimate | PooledSize):
        raise UsageError("pool takes several maps; give a list")
    found = estimated(sequence_of("maps", maps, "maps, paths or estimates"), settings)
    if not found:
        raise UsageError("there is no map to pool; give at least one")
    prints = [one.tactile_map.fingerprint for one in found]
    if len(set(prints)) < len(prints):
        raise UsageError("a map is given twice; give each map once")
    names = [one.name or f"map {i}" for i, one in enumerate(found, start=1)]
    return pool_estimates(found, used, names=names)


def estimated(given: Iterable[Any], settings: Mapping[str, Any]) -> tuple[SizeEstimate, ...]:
    """Estimates of maps, or of their paths; those that are estimates already keep their own settings."""
    return tuple(one if isinstance(one, SizeEstimate) else estimate(one, **settings) for one in given)


def listed(given: Any) -> list[Any]:
    """One map, estimate, pooled size or path as a list of it; a list of them as it is."""
    if isinstance(given, str | Path | Map | SizeEstimate | PooledSize):
        return [given]
    return list(sequence_of("files", given, "maps, estimates or paths"))
