"""An estimate's result, with its sensitivity to priors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np

from tactile_bayes.declarations import Record, as_dict
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import ParameterDraws, weighted_quantiles_of
from tactile_bayes.inference.importance import smooth_weights
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.detection import Detection
from tactile_bayes.posterior.draw import Diagnostics, MapPosterior, ModalBump
from tactile_bayes.posterior.lump_probability import Weighed
from tactile_bayes.posterior.white import BumpFit, Candidate
from tactile_bayes.size.draws import SizePosterior

if TYPE_CHECKING:
    from tactile_bayes.posterior.lump_probability import SmallestLumps
    from tactile_bayes.posterior.selection import SceneChoice


# --- Prior sensitivity: the draws reweighted under a width prior twice as wide.

WIDER = 2.0
TAIL = 0.025


class Sensitivity(Record):
    """Effect of doubling the width prior's SD, in posterior SDs."""

    median: Mapping[str, float]
    ends: Mapping[str, float]
    """`median`, `ends`: By quantity: shift of the median, and the larger shift of the two ends of the 95 % interval."""
    pareto_k: float
    """Shape of the weights; above 0.7 the shifts are not to be trusted."""

    def as_dict(self) -> dict[str, object]:
        """Plain data."""
        return {"width_prior_times": WIDER, "median_sd": dict(self.median), "ends_sd": dict(self.ends)}


def prior_sensitivity(
    sigma_x: FloatArray, sigma_y: FloatArray, quantities: Mapping[str, FloatArray], prior: BumpPrior
) -> Sensitivity:
    """Shifts of quantities under a width prior twice as wide, by reweighting without another fit.

    Quantities are draws in the order of the widths'; those of another shape are left out, NaN draws count for nothing.
    """
    p = 0.5 * np.log(sigma_x * sigma_y).ravel()
    z = (p - np.log(prior.width_median_mm)) / prior.log_width_sd
    weight, shape = smooth_weights(0.5 * z**2 * (1.0 - WIDER**-2))
    medians, ends = {}, {}
    for name, draws in quantities.items():
        values = draws.ravel()
        if values.shape != weight.shape:
            continue
        good = np.isfinite(values)
        sd = float(values[good].std()) or 1.0
        at = np.array([0.5, TAIL, 1.0 - TAIL])
        order = np.argsort(values[good])
        ordered, weighed = values[good][order], weight[good][order]
        plain = weighted_quantiles_of(ordered, np.ones(len(order)), at)
        shift = (weighted_quantiles_of(ordered, weighed, at) - plain) / sd
        medians[name], ends[name] = float(shift[0]), float(shift[1:][np.argmax(np.abs(shift[1:]))])
    return Sensitivity(medians, ends, shape)


# --- The answer for one map: an estimate, or the reason why there is none.

Status = Literal["estimate", "no_estimate"]


class Rise(Record):
    """Another rise on the map."""

    x_mm: float
    y_mm: float
    """`x_mm`, `y_mm`: Its centre in `plane`."""
    distance_mm: float | None
    """From the lump that was measured; None where there is none."""
    amplitude: float
    sigma_x_mm: float
    sigma_y_mm: float
    """`amplitude`, `sigma_x_mm`, `sigma_y_mm`: Of its bump at the mode; widths along the axes of its ellipse."""
    probability: float
    """That it is a lump, as `Detection` has it."""

    def as_dict(self) -> dict[str, float | None]:
        """Plain data, as in the JSON."""
        return {name: None if value is None else float(f"{value:.6g}") for name, value in as_dict(self).items()}


class Estimate(Record, eq=False):
    """The answer for one map."""

    status: Status
    reason: str
    """`status`, `reason`: ``"estimate"``, or ``"no_estimate"`` and why. With an estimate the reason says what is
    missing from it, if anything.
    """
    detection: Detection | None = None
    """None when no bump could be tested."""
    fit: BumpFit | None = None
    draws: ParameterDraws | None = None
    map_posterior: MapPosterior | None = None
    size: SizePosterior | None = None
    """`fit`, `draws`, `map_posterior`, `size`: None without an estimate; `size` is None also without a size
    calibration.
    """
    candidates: tuple[Candidate, ...] = ()
    """Every place that was looked at."""
    diagnostics: Diagnostics | None = None
    """Figures and flags for the report; None where nothing was drawn."""
    left_out: tuple[str, ...] = ()
    """Sources of error that the estimate does not contain, in words."""
    code: str = ""
    advice: str = ""
    on_paper: str = ""
    about_mm: tuple[float, float] | None = None
    """`code`, `advice`, `on_paper`, `about_mm`: Without an estimate: as in `Abstention`."""
    weighed: Weighed | None = None
    """The lump of the answer, or the rise that is most like one, with its probability; None where nothing was weighed.
    """
    smallest: SmallestLumps | None = None
    """On a map without a lump: the smallest that it would have shown; None where nobody has asked."""
    scene: SceneChoice | None = None
    """Under a noise field: what the window holds, and what was asked about it."""
    sensitivity: Sensitivity | None = None
    """How far the answer leans on the prior of the widths."""
    other_rises: tuple[Rise, ...] = ()
    """Other rises that are lumps by the evidence, see `other_rises.other_rises`; empty where nobody has looked."""
    bump: ModalBump | None = None
    """The bump at the mode of the lump that the answer is about, sized or not; None where there is no lump."""
    masses: tuple[Mass, ...] = ()
    """All masses of the map, see `masses.with_masses`; empty where nobody has looked."""
    findings: tuple[Finding, ...] = ()
    """Findings against the answer, cautions first."""

    @property
    def probability(self) -> float | None:
        """Probability that the lump of the answer, or the likeliest rise, is one; None where nothing was weighed."""
        return None if self.weighed is None else self.weighed.probability


class Mass(Record, eq=False):
    """One of the masses on a map."""

    x_mm: float
    y_mm: float
    """`x_mm`, `y_mm`: Its centre in `plane`: the posterior median, or where the fit has it."""
    probability: float
    """That it is a lump; of a second lump in another's window, by its odds."""
    estimate: Estimate
    """Its own: draws and size, or why there is none."""
    reported: bool = False
    """The map's `Estimate` is this mass's."""

    @property
    def largest_mm(self) -> float | None:
        """Median of the largest diameter; None without a size."""
        size = self.estimate.size
        return None if size is None else size.median_mm
