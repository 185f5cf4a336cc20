"""Sizes from a fraction of the draws: for tests of what stands around them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tactile_bayes.api import estimating
from tactile_bayes.declarations import replace
from tactile_bayes.size import pooling, visits

DRAWS = 1000
_options = estimating._options


def _few(*asked: Any) -> Any:
    return replace(_options(*asked), draws=DRAWS)


@pytest.fixture(scope="module", autouse=True)
def few_draws() -> Iterator[None]:
    """Take fewer draws about a mode, of pooled sizes and of changes in this process; worker processes take all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimating, "_options", _few)
        patch.setattr(pooling, "POOLED_DRAWS", DRAWS)
        patch.setitem(visits.joint_sizes.__kwdefaults__, "number", DRAWS)
        yield
