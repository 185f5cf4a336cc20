"""Reasons to look at a site's correction before it is used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tactile_bayes.size.body_calibration import BodyCalibration
    from tactile_bayes.size.learn.site_shift import Residuals, ShiftPosterior, SitePrior

FAR = 3.0
"""Standard deviations of the prior beyond which a shift is named."""
APART = 3.5
"""The same of the prediction for a phantom; one of 20 phantoms is named by chance in 1 site of 30 (record 0102)."""
SLOPE_OPEN, ALIKE = 0.8, 0.2
"""A slope is open where it keeps this share of the prior's SD, and the SD of the phantoms' ln sigma is below this."""
MOST_SPREAD = 2.0


def cautions_of(
    names: Sequence[str],
    data: Residuals,
    found: ShiftPosterior,
    prior: SitePrior,
    *,
    posterior_of: Callable[[Residuals, SitePrior], ShiftPosterior],
) -> tuple[str, ...]:
    """What is odd about a correction, in words.

    Parameters
    ----------
    names
        Of the phantoms.
    posterior_of
        Learns the shift again, for the phantoms without one.
    """
    lines = []
    for value, sd, what in zip(found.mean[:2], prior.sd, ("shift", "slope with ln sigma"), strict=True):
        if abs(value) > FAR * sd:
            lines.append(
                f"the {what} of {value:+.2f} in ln d is {abs(value) / sd:.1f} times what sites are expected to differ "
                "by: check the sizes' unit, the recipe of the maps and the head"
            )
    if data.width.std() < ALIKE and np.sqrt(found.covariance[1, 1]) > SLOPE_OPEN * prior.slope_sd:
        lines.append(
            "the phantoms' maps are too alike in width to tell whether the shift changes with it: "
            "add smaller and larger phantoms"
        )
    if found.spread > MOST_SPREAD:
        lines.append(
            f"the phantoms scatter {found.spread:.1f} times as much as the calibration expects: "
            "check their sizes, depths, seats and stiffness"
        )
    return (*lines, *_apart(names, data, prior, posterior_of))


def no_depth(calibration: BodyCalibration, known: Sequence[Mapping[str, float]]) -> tuple[str, ...]:
    """The caution where the depth of phantoms is not known, though a size depends on it most."""
    names = () if calibration.hidden is None else calibration.hidden.names
    without = sum("depth_mm" not in one for one in known)
    if "depth_mm" not in names or not without:
        return ()
    return (
        f"{without} of {len(known)} phantoms have no depth_ratio: where they lie deeper or shallower than lumps of the "
        "calibration, this passes for the site's; state depth_ratio, seat and stiffness_ratio",
    )


def _apart(
    names: Sequence[str],
    data: Residuals,
    prior: SitePrior,
    posterior_of: Callable[[Residuals, SitePrior], ShiftPosterior],
) -> list[str]:
    """Phantoms that lie far from what the others predict."""
    lines = []
    for i, name in enumerate(names):
        others = posterior_of(data.without(i), prior)
        x = data.design[i]
        variance = x @ others.covariance @ x + others.spread_square * data.spread_variance[i] + data.map_variance[i]
        score = float((data.residual[i] - x @ others.mean) / np.sqrt(variance))
        if abs(score) > APART:
            lines.append(f"{name} lies {abs(score):.1f} SDs from what the other phantoms predict: look at its map")
    return lines
