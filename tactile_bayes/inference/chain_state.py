"""State of an interrupted ensemble, from which it continues exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tactile_bayes.geometry import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ChainState:
    """State of all ensembles after the same number of steps.

    Parameters
    ----------
    chain : (ensemble, step, walker, p) array
        In standardised coordinates.
    log_density : (ensemble, walker) array
        At the last step.
    accepted : (ensemble,) array
        Mean accepted proposals of a walker so far.
    twister : (ensemble, 624) uint32 array
        The random generators' keys.
    cursor : (ensemble, 3) array
        Their positions, whether a normal draw is kept, and that draw.
    """

    chain: FloatArray
    log_density: FloatArray
    accepted: FloatArray
    twister: np.ndarray[tuple[int, ...], np.dtype[np.uint32]]
    cursor: FloatArray

    def as_arrays(self) -> Mapping[str, Any]:
        """The state as arrays by name."""
        return {name: getattr(self, name) for name in self.__slots__}


class ChainStore(Protocol):
    """Interface of a store for the state, under a key for what it belongs to."""

    def load(self, key: str) -> ChainState | None:
        """Load the state of this key; None without one. Another key's state is an error."""

    def save(self, key: str, state: ChainState) -> None:
        """Store a state in place of the last one."""
