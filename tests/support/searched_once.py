"""The estimate of a map and the search in it, which tell the same each time, made once for a map and its options.

For tests of what stands around an estimate: commands, files, pages. Tests of the estimate itself do not use it.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tactile_bayes.api import estimating, sized
from tactile_bayes.posterior import estimate, masses, result, verdict

KEPT = 64
_searched = estimate.search
_made: dict[bytes, Any] = {}


def _once(function: Callable[..., Any], *asked: Any, key: Any = None, **named: Any) -> Any:
    """What the function gave before for these arguments, or for what stands in their place as a `key`."""
    digest = hashlib.sha256(pickle.dumps((function.__name__, asked, named if key is None else key))).digest()
    if digest not in _made:
        found = function(*asked, **named)
        while len(_made) >= KEPT:
            del _made[next(iter(_made))]
        _made[digest] = found
    return _made[digest]


def _search(*asked: Any) -> Any:
    return _once(_searched, *asked)


def _smallest_lumps(*asked: Any, **named: Any) -> Any:
    return _once(verdict.smallest_lumps, *asked, **named)


def _inference_groups(*asked: Any, **named: Any) -> Any:
    return _once(result.inference_groups, *asked, **named)


def _estimate_map(tactile_map: Any, *, options: Any, progress: Any = None, **named: Any) -> Any:
    """An estimate with a checkpoint has a state of its own; whoever watches one sees no draws of one made before."""
    if options.store is not None:
        return estimate.estimate_map(tactile_map, options=options, progress=progress, **named)
    key = {"options": options, **named}
    return _once(estimate.estimate_map, tactile_map, key=key, options=options, progress=progress, **named)


@pytest.fixture(scope="module", autouse=True)
def searched_once() -> Iterator[None]:
    """Give back what this module found before on the same map with the same options.

    Another module's tests may have had other functions below in place.
    """
    _made.clear()
    with pytest.MonkeyPatch.context() as patch:
        for module in (estimate, masses):
            patch.setattr(module, "search", _search)
        patch.setattr(estimating, "smallest_lumps", _smallest_lumps)
        patch.setattr(sized, "inference_groups", _inference_groups)
        patch.setattr(estimating, "estimate_map", _estimate_map)
        yield
