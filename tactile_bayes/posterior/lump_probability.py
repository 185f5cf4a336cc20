"""Probability that a rise of a map is a lump, calibrated on simulated exams with and without one."""

from __future__ import annotations

from math import exp, log, log1p
from typing import Final

import numpy as np

from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.lump.cells import covered_share
from tactile_bayes.posterior.options import DETECTED
from tactile_bayes.posterior.white.detection import Detection
from tactile_bayes.posterior.white.fit import Candidate
from tactile_bayes.records import dataclass

SHARE_WITH_LUMP: Final = 0.5
"""Of the simulated exams, half hold a lump: the prior probability behind the answer."""
COEFFICIENTS: Final = (1.14, 0.8, -2.36, -4.3, -2.32, -2.47)
"""Of 1 and `Weighed.features`; ``python -m benchmarks.lump_probability learn`` prints them (decision 0127)."""
ENDS: Final = (0.01, 0.99)
"""The exams that were simulated cannot tell probabilities nearer to 0 or 1."""
LIKELY: Final = 0.5
"""A rise with a lower probability is no lump by the verdict, whatever its evidence."""
UNPROVEN: Final = 0.49
"""Most that is told of a rise without the evidence for a size: it is not told as a lump."""
MOST_EVIDENCE: Final = 50.0
WIDE_MM: Final = 8.0
NO_EVIDENCE: Final = "no lump by the evidence"


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """A rise with the odds of a bump there, and the probability that it is a lump.

    Parameters
    ----------
    detection
        Of a bump against smooth errors, and a ridge where one rises.
    centre_mm
        Of the bump.
    features
        Log of 1 plus the log Bayes factor, log of the axis ratio, by how much the log of the width exceeds that of
        `WIDE_MM`, share of the bump that the map does not cover, and 1 where a fault speaks against measuring it.
    candidate
        Where the search met it.
    """

    detection: Detection
    centre_mm: tuple[float, float]
    features: tuple[float, ...]
    candidate: Candidate | None = None

    @property
    def axis_ratio(self) -> float:
        """Of the bump, at most e^2."""
        return exp(self.features[1])

    @property
    def probability(self) -> float:
        """Probability of a lump, where half of the exams hold one.

        The evidence of a bump is against smooth errors. Rims, ridges, ribs, creases and uneven fat rise, too; they are
        told by the other features.
        """
        score = COEFFICIENTS[0] + float(np.dot(COEFFICIENTS[1:], self.features))
        most = ENDS[1] if self.detection.probability >= DETECTED else UNPROVEN
        return float(np.clip(1.0 / (1.0 + exp(-score)), ENDS[0], most))


def weigh(
    tactile_map: TactileMap,
    detection: Detection,
    *,
    centre_mm: tuple[float, float],
    widths_mm: tuple[float, float],
    fault: str = "",
) -> Weighed:
    """A rise of known place and widths; `fault` as of a `Candidate`."""
    wide, narrow = max(widths_mm), max(min(widths_mm), 1e-3)
    evidence = log1p(float(np.clip(detection.log_bayes_factor, 0.0, MOST_EVIDENCE)))
    too_wide = max(log(max(wide, 1e-3) / WIDE_MM), 0.0)
    open_share = 1.0 - covered_share(tactile_map, centre_mm, radius_mm=1.5 * wide)
    faulty = float(bool(fault) and not fault.startswith(NO_EVIDENCE))
    return Weighed(
        detection, centre_mm, (evidence, min(log(wide / narrow), 2.0), min(too_wide, 2.0), open_share, faulty)
    )


def weigh_candidate(tactile_map: TactileMap, candidate: Candidate, detection: Detection) -> Weighed | None:
    """The same of a candidate, by its least-squares bump; None without one."""
    fit = candidate.fit
    if fit is None:
        return None
    centre, widths = (float(fit.theta[1]), float(fit.theta[2])), fit.widths()[:2]
    return weigh(tactile_map, detection, centre_mm=centre, widths_mm=widths, fault=candidate.fault)
