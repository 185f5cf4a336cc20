"""Draws of a model's parameters, the result of every method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

END_ERROR = 2.67
"""Monte-Carlo error of an end of a 95 % interval, in SDs, times the root of the independent draws (normal tails)."""
INDEPENDENT_DRAWS = 4000
"""Draws of the methods that draw independently: end-point Monte-Carlo error of a 95 % interval about 0.04 SD."""
REPLICATES = 4
"""Independent parts of every set of draws; what differs between them is the Monte-Carlo error."""
Labels = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def even_replicates(number: int) -> Labels:
    """(number,) labels that divide independent draws into `REPLICATES` parts of equal size."""
    return np.arange(number) * REPLICATES // max(number, 1)


@dataclass(frozen=True, slots=True, eq=False)
class ParameterDraws:
    """Draws of a parameter vector.

    Parameters
    ----------
    theta : (chain, draw, p) array
    method
        One of `presets.METHODS`.
    diagnostics
        Figures of the method (R-hat, effective draws, evaluations...), for the report.
    labels : (chain * draw,) array or None
        The independent replicate that each draw comes from, for draws in one chain; None for independent draws.
    statistics
        (chain, draw) arrays of the sampler by name: ``lp``, the log density at the draw; ``log_weight``, of the point
        that importance sampling took it from; ``accepted``, 1 where the chain's walker moved there in that step.
    """

    theta: FloatArray
    method: str
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    labels: Labels | None = None
    statistics: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def flat(self) -> FloatArray:
        """(chain * draw, p) draws of all chains."""
        return self.theta.reshape(-1, self.theta.shape[-1])

    @property
    def replicates(self) -> Labels:
        """(chain * draw,) label of the independent replicate of each draw; chains are independent of each other."""
        chains, draws = self.theta.shape[:2]
        if self.labels is not None:
            return self.labels
        return even_replicates(draws) if chains == 1 else np.repeat(np.arange(chains), draws) % REPLICATES

    @property
    def effective_draws(self) -> float:
        """Effective draws for an interval's end: the smallest tail ESS, or all when independent."""
        return float(min(self.diagnostics.get("ess_tail", np.inf), len(self.flat)))


def student_draws(
    centre: FloatArray, scale: FloatArray, *, dof: float, number: int, rng: np.random.Generator
) -> FloatArray:
    """(number, p) draws of a multivariate t: normal draws whose noise scale is itself uncertain.

    Parameters
    ----------
    centre, scale : (p,), (p, p) arrays
        Location and scale matrix, which may be near-singular.
    dof
        Degrees of freedom of the noise estimate; ``inf`` gives normal draws.
    """
    values, vectors = np.linalg.eigh(scale)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    normal = rng.standard_normal((number, len(centre))) @ root.T
    if np.isinf(dof):
        return np.asarray(centre + normal)
    return np.asarray(centre + normal * np.sqrt(dof / rng.chisquare(dof, size=number))[:, None])


def picked_rows(have: Labels, wanted: Labels, rng: np.random.Generator) -> Labels:
    """Indices of draws with the wanted labels, using a replicate's draws equally often."""
    index = np.empty(len(wanted), dtype=np.intp)
    for label in range(REPLICATES):
        members, places = np.flatnonzero(have == label), np.flatnonzero(wanted == label)
        members = members if len(members) else np.arange(len(have))
        index[places] = rng.permutation(np.resize(rng.permutation(members), len(places)))
    return index
