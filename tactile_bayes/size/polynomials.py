"""Products of powers: the terms of a polynomial in several variables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray


def powers(order: int) -> tuple[tuple[int, int], ...]:
    """Powers of two variables up to an order in all, lower orders first: 1, u, v, u2, uv, v2, u3..."""
    return tuple((total - j, j) for total in range(order + 1) for j in range(total + 1))


def monomials(values: Sequence[FloatArray], exponents: Sequence[tuple[int, ...]]) -> FloatArray:
    """(..., terms) products of the (...) values' powers."""
    highest = max(max(one) for one in exponents)
    raised = [_raised(np.asarray(value, dtype=np.float64), highest) for value in values]
    found = np.stack([raised[0][one[0]] for one in exponents], axis=-1)
    for i in range(1, len(values)):
        found *= np.stack([raised[i][one[i]] for one in exponents], axis=-1)
    return found


def _raised(value: FloatArray, highest: int) -> list[FloatArray]:
    """Powers from 0 up, by multiplication."""
    found = [np.ones_like(value)]
    for _ in range(highest):
        found.append(found[-1] * value)
    return found
