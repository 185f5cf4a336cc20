"""A size calibration as text for people."""

from __future__ import annotations

from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.eq6 import COEFFICIENTS, AxisCalibration, LeftOutErrors, SizeCalibration
from tactile_bayes.size.learn.eq6 import OtherFit, is_two_stage

LABELS = {
    "m": "m",
    "b_mm": "b, mm",
    "e": "e",
    "f": "f",
    "scatter": "residual SD of ln d",
    "scatter_slope": "  its slope with ln a",
}


def calibration_text(
    calibration: SizeCalibration,
    *,
    not_left_out: str = "",
    other_fit: OtherFit | None = None,
) -> str:
    """Text of a size calibration: fit, domain and r2 of each axis, and recipe.

    Parameters
    ----------
    not_left_out
        Why the table's geometries could not be left out in turn, where that is so.
    other_fit
        What the other of the two fits makes of the same rows.
    """
    how = "two-stage fit as printed +- SD of a bootstrap" if is_two_stage(calibration) else "posterior mean +- SD"
    lines = [f"Eq 6: d = m sigma / (e a^f) + b, {how}"]
    both = calibration.axes == ("both",)
    axes = [("both axes", calibration.x)] if both else [("across, x", calibration.x), ("along, y", calibration.y)]
    lines.append(f"{'':24}" + "".join(f"{name:>22}" for name, _ in axes))
    for index, name in enumerate(COEFFICIENTS):
        cells = [f"{a.draws[:, index].mean():.3f} +- {a.draws[:, index].std():.3f}" for _, a in axes]
        lines.append(f"{LABELS[name]:24}" + "".join(f"{cell:>22}" for cell in cells))
    lines += _figures([axis for _, axis in axes])
    lines.append(f"residual SD is given at amplitude {calibration.x.reference_amplitude:.3g}; fainter maps tell less")
    if not both:
        lines.append(f"correlation of the two residuals {calibration.residual_correlation:.2f}")
    if not calibration.x.fit.get("e_identified"):
        lines.append("the table has no depths: only m/e is determined, e is 1 by convention")
    if other_fit is not None:
        lines.append(_other_fit(other_fit))
    if calibration.left_out is not None:
        lines += _left_out(calibration.left_out)
    elif not_left_out:
        lines.append(f"leave one geometry out: not known, {not_left_out}")
    recipe = calibration.recipe
    how = "declared" if recipe.declared else "as the maps were made here"
    lines.append(f"recipe ({how}): {recipe}")
    lines.append(f"for maps made with {recipe.map_command}, on which `estimate` fits by this recipe itself")
    lines += [f"CAUTION: {text}" for text in calibration.cautions]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _other_fit(other: OtherFit) -> str:
    """How far the other fit lies, in one line."""
    words = {"two-stage": "two-stage fit as printed", "joint": "joint fit of all rows"}[other.name]
    fits = [f"m {m:.2f}, b {b:.2f} mm, e {e:.3f}, f {f:.3f}" for m, b, e, f in other.coefficients]
    differences = " and ".join(f"{100 * share:.0f} %" for share in other.difference)
    return f"{words}: {'; along '.join(fits)}; sizes differ by {differences} of d on average"


def _left_out(errors: LeftOutErrors) -> list[str]:
    """Cross-validated mean absolute error of both forms, by both widths and by each."""
    names = {"both": "", "x": "by the width across alone, ", "y": "by the width along alone, "}
    said = [
        f"{words}Eq 6 {100 * errors.eq6[widths]:.1f} %, log-quadratic {100 * errors.log_quadratic[widths]:.1f} %"
        for widths, words in names.items()
        if widths in errors.eq6
    ]
    which = f"{errors.cases} cases of E2/E1 >= {errors.least_stiffness_ratio:g}"
    return [f"leave one geometry out: {said[0]} of d ({errors.geometries} geometries, {which})", *said[1:]]


def _figures(axes: list[AxisCalibration]) -> list[str]:
    rows = [
        ("r2 of ln d", [f"{axis.fit.get('r2', float('nan')):.2f}" for axis in axes]),
        ("mean absolute error", [f"{axis.fit.get('mae_percent', float('nan')):.0f} %" for axis in axes]),
        ("rows", [f"{axis.fit.get('rows', 0):.0f}" for axis in axes]),
    ]
    for name, unit in (("amplitude", ""), ("sigma_mm", " mm"), ("d_mm", " mm")):
        cells = [f"{axis.domain[name][0]:.3g} to {axis.domain[name][1]:.3g}{unit}" for axis in axes]
        rows.append((f"range of {name.removesuffix('_mm')}", cells))
    return [f"{label:24}" + "".join(f"{cell:>22}" for cell in cells) for label, cells in rows]
