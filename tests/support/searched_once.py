"""The search for a lump, which is most of an estimate and draws no random number, made once for a map and its options.

For tests of what stands around an estimate: commands, files, pages. Tests of the estimate itself do not use it.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import pytest

from tactile_bayes.posterior import estimate, masses, search

KEPT = 32


@lru_cache(maxsize=KEPT)
def _found(asked: bytes) -> Any:
    return search.search(*pickle.loads(asked))


def _search(*asked: Any) -> Any:
    return _found(pickle.dumps(asked))


@pytest.fixture(scope="module", autouse=True)
def searched_once() -> Iterator[None]:
    """Give back what was found before on the same map with the same options."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (estimate, masses):
            patch.setattr(module, "search", _search)
        yield
