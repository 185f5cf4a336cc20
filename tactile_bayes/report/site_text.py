"""A site's correction of a size calibration as text for people."""

from __future__ import annotations

from tactile_bayes.presets import INTERVAL, RESEARCH_USE
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.terms import SiteShift


def site_words(site: SiteShift, log_width: float | None = None) -> str:
    """Which calibration was corrected, by how many phantoms and by how much.

    Parameters
    ----------
    log_width
        ln of the mean width in mm of the map in question; that of the phantoms where left out.
    """
    p = site.phantoms_log_width if log_width is None else log_width
    middle, low, high = site.percent(p)
    by = f"{site.phantoms} phantoms of this site"
    return f"{site.base}, corrected by {by}: {round(middle):+d} % ({100 * INTERVAL:g} %: {round(low)} to {round(high)})"


def site_calibration_text(calibration: BodyCalibration) -> str:
    """The correction: shift, slope, what it leaves, and what is odd about it."""
    site = calibration.site
    if site is None:
        raise ValueError("the calibration has no correction")
    (shift, slope), fit = site.mean, site.fit
    shift_sd, slope_sd = (float(site.covariance[i, i]) ** 0.5 for i in range(2))
    lines = [f"CAUTION: {text}" for text in site.cautions] + [
        f"{site_words(site)}, for maps as wide as theirs",
        f"added to ln d: {shift:+.3f} +- {shift_sd:.3f}, and {slope:+.3f} +- {slope_sd:.3f} times "
        f"(ln sigma {-site.centre:+.3f}), posterior mean +- SD",
    ]
    if fit:
        lines.append(
            f"ln d of the phantoms about the calibration, root mean square: {fit['sd_before']:.3f}, "
            f"corrected {fit['sd_after']:.3f}; their spread is {fit['spread_factor']:.1f} times the expected one"
        )
    maps = "" if site.maps == site.phantoms else f" ({site.maps} maps)"
    lines.append(f"{site.phantoms} phantoms{maps}; the depth of fat is {'' if site.uses_fat else 'not '}used")
    lines += [f"left out: {text}" for text in site.left_out]
    lines.append(f"recipe: {calibration.recipe}")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"
