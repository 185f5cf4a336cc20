r"""Eq 6, the paper's law of the diameter: d = m sigma / (e a^f) + b.

Over a population it is taken in logarithms, with constants that depend on the depth of the fat. With
:math:`u = \ln a - \alpha_0`, :math:`v = p - p_0` and :math:`w = \ln F - w_0`, p the log of the geometric mean width and
F the depth of the fat,

.. math:: d = e^{\mu + v - f u} + b, \qquad
          \frac{m}{e} = e^{\mu - p_0 + f\alpha_0}, \quad e = a_1^{-f},

where :math:`a_1` is the amplitude that lumps one diameter deep show on average, for Delta sigma is 1 there. mu and f
are full quadratics in v and w: what Eq 6 takes for constants depends on how deep the fat is, in mm and in widths of the
map. Without a depth of fat the three are constants.

From a study or phantoms it is learned for each axis of the head, as draws of its coefficients (`SizeCalibration`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Meta, Record, field, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, Matrix, Vector
from tactile_bayes.inference.draws import even_replicates, paired_points
from tactile_bayes.size import terms
from tactile_bayes.size.draws import BetweenMaps, BumpDraws, SizePosterior, shares

MU, F, B = range(3)
Power = tuple[Annotated[int, Meta(ge=0, le=9)], Annotated[int, Meta(ge=0, le=9)], Annotated[int, Meta(ge=0, le=9)]]
Powers = tuple[tuple[int, int, int], ...]
PLAIN: Final[Powers] = ((MU, 0, 0), (F, 0, 0), (B, 0, 0))
"""Which of mu, f and b each coefficient belongs to, and its powers of v and w, where no depth of fat is known."""
BY_DEPTH: Final[Powers] = (*((row, i, k) for row in (MU, F) for k in range(3) for i in range(3 - k)), (B, 0, 0))
"""The same of the thirteen with the depth of fat; see docs/decisions/0093."""


class Eq6Law(Record, eq=False):
    """Posterior of Eq 6's coefficients over a population, taken as normal: d = exp(mu + v - f u) + b."""

    powers: tuple[Power, ...]  #: Which of mu (0), f (1) and b (2) each coefficient is of, and its powers of v and w.
    mean: Vector
    covariance: Matrix
    log_amplitude_one_deep: float  #: ln a of lumps one diameter deep, where Delta sigma is 1: e = exp(-f times this).

    def __post_init__(self) -> None:
        k = len(self.powers)
        terms.check_shapes(self, mean=(k,), covariance=(k, k))
        if any(row > B for row, _, _ in self.powers):
            raise BadDataError("powers names more than mu, f and b", way_out=terms.LEARN_ANEW)


def eq6_coefficients(theta: Sequence[float] | FloatArray, powers: Powers, v: FloatArray, w: FloatArray) -> FloatArray:
    """(3, ...) mu, f and b of maps, for coefficients in the order of `powers`."""
    coefficients = np.zeros((3, *np.broadcast_shapes(v.shape, w.shape)))
    for value, (row, i, k) in zip(theta, powers, strict=True):
        coefficients[row] += value * v**i * w**k
    return coefficients


def eq6_parts(
    u: FloatArray, v: FloatArray, w: FloatArray, theta: FloatArray, powers: Powers
) -> tuple[FloatArray, FloatArray]:
    """The term of Eq 6 that is proportional to sigma, and d, both (...,) in mm; d is NaN where it is not positive."""
    mu, f, b_mm = eq6_coefficients(theta, powers, v, w)
    stretched = np.exp(mu + v - f * u)
    size = stretched + b_mm
    return stretched, np.where(size > 0, size, np.nan)


def eq6_terms(u: FloatArray, v: FloatArray, w: FloatArray, theta: FloatArray, powers: Powers) -> FloatArray:
    """(..., k) derivatives of ln d by the coefficients; NaN where Eq 6 has no positive size."""
    stretched, size = eq6_parts(u, v, w, theta, powers)
    share = stretched / size
    slopes = (share, -u * share, 1.0 / size)
    return np.stack([slopes[row] * v**i * w**k for row, i, k in powers], axis=-1)


def eq6_log_size(u: FloatArray, v: FloatArray, w: FloatArray, theta: FloatArray, powers: Powers) -> FloatArray:
    """(...,) ln d, d in mm."""
    return np.asarray(np.log(eq6_parts(u, v, w, theta, powers)[1]))


COEFFICIENTS: Final = ("m", "b_mm", "e", "f", "scatter", "scatter_slope")


class AxisCalibration(Record, eq=False):
    r"""Draws of Eq 6's coefficients for the widths along one axis of the head.

    The residual standard deviation of ln d is :math:`s\,(a / a_0)^{-g}`: fainter maps tell less.
    """

    draws: Matrix  #: m, b (mm), e, f, scatter and its slope in each row.
    reference_amplitude: terms.Above0  #: Of the scatter.
    domain: terms.Domain
    fit: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        terms.check_shapes(self, draws=(max(len(self.draws), 1), len(COEFFICIENTS)))
        terms.check_domain(self.domain)

    def size_mm(self, sigma_mm: FloatArray, amplitude: FloatArray, *, draws: FloatArray | None = None) -> FloatArray:
        r"""Diameter in mm by Eq 6, without residual scatter: :math:`d = m\,\sigma / (e\,a^f) + b`.

        For (n,) values and (n, 6) or (6,) draws, the mean of the posterior when left out; NaN where the amplitude is
        not positive. Wellman & Howe (1999) eq. 6 with their Delta sigma as a ratio of widths, 1 at one diameter depth.
        """
        coefficients = self.draws.mean(axis=0) if draws is None else draws
        m, b, e, f = (coefficients[..., i] for i in range(4))
        with np.errstate(invalid="ignore", divide="ignore"):
            width_change = e * np.where(amplitude > 0, amplitude, np.nan) ** f
            return np.asarray(m * sigma_mm / width_change + b)

    def scatter(self, amplitude: FloatArray, *, draws: FloatArray | None = None) -> FloatArray:
        """(n,) residual standard deviation of ln d at each amplitude."""
        coefficients = self.draws.mean(axis=0) if draws is None else draws
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(amplitude > 0, amplitude, np.nan) / self.reference_amplitude
            return np.asarray(coefficients[..., 4] * ratio ** -coefficients[..., 5])


class LeftOutErrors(Record):
    """Cross-validated errors of sizes, leaving out each geometry of a study in turn.

    Mean absolute errors in d as a share, of Eq 6 and of a quadratic of ln d in ln a and ln sigma: by the widths x
    across the head, y along it, or both.
    """

    cases: Annotated[int, Meta(ge=1)]
    geometries: Annotated[int, Meta(ge=1)]
    least_stiffness_ratio: terms.Share  #: Softer lumps took no part.
    eq6: Annotated[Mapping[str, terms.Share], Meta(extra_json_schema={"required": ["both"]})]
    log_quadratic: Annotated[Mapping[str, terms.Share], Meta(extra_json_schema={"required": ["both"]})]

    def __post_init__(self) -> None:
        if not {"both"} <= set(self.eq6) <= {"x", "y", "both"} or set(self.log_quadratic) != set(self.eq6):
            raise BadDataError("left_out has errors by other widths than x, y and both", way_out=terms.LEARN_ANEW)


class SizeCalibration(Record, eq=False):
    """Eq 6 for each axis of the head, from a study or phantoms: the same for all maps, whatever their fat."""

    x: AxisCalibration  #: Across the head.
    y: AxisCalibration  #: Along the head; the same where the table has one width.
    residual_correlation: Annotated[float, Meta(ge=-1, le=1)]
    """A lump that looks large along one axis tends to along the other."""
    recipe: terms.Recipe
    axes: Annotated[tuple[Literal["x", "y", "both"], ...], Meta(min_length=1, max_length=2)] = ("x", "y")
    left_out: LeftOutErrors | None = None
    cautions: tuple[str, ...] = ()  #: What of the table's lumps is of one kind, or unlike a patient's.

    fat_mm: ClassVar[None] = None  #: Depth of fat of the calibration: none for Eq 6.

    def __repr__(self) -> str:
        return terms.calibration_words(type(self), "Eq 6 of lumps", self.recipe, self.x.domain, self.cautions)

    def at_fat(self, *_map: object) -> SizeCalibration:
        """This calibration: Eq 6 is the same for all maps, whatever their depth of fat."""
        return self

    at_depth_or_fallback = at_fat

    def outside(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float, *, far: bool = False) -> list[str]:
        """Texts on a map that lies or may lie outside the axes' tables, or so `far` outside that there is no size."""
        axes = (("x", self.x.domain, sigma_x_mm), ("y", self.y.domain, sigma_y_mm))
        texts = [
            f"{name}: {text}"
            for name, domain, mm in axes
            for text in terms.outside_domain(domain, amplitude, mm, far=far)
        ]
        return texts if far else [*self.cautions, *texts]

    def within_reach(self, amplitude: FloatArray, sigma_x_mm: FloatArray, sigma_y_mm: FloatArray) -> BoolArray:
        """(n,) True for maps near enough to the tables for a size."""
        by_x = terms.within_reach(self.x.domain, amplitude, sigma_x_mm)
        return np.asarray(by_x & terms.within_reach(self.y.domain, amplitude, sigma_y_mm))

    def beyond_lumps(self, size: SizePosterior) -> list[str]:
        """Texts on a size beyond the tables' lumps; empty within."""
        return terms.beyond_lumps(self.x.domain, size.median_mm, size.axis_ratio)

    def omissions(self) -> list[str]:
        """Sources of error that a size does not contain, in words."""
        return [terms.ONE_WIDTH] if self.axes == ("both",) else []

    @property
    def in_two_stages(self) -> bool:
        """True where it was learned in the two stages of the paper's section 2.4."""
        return self.x.fit.get("two_stage", 0.0) == 1.0


def push_sizes(
    bump: BumpDraws, *, calibration: SizeCalibration, rng: np.random.Generator, another_exam: BetweenMaps | None = None
) -> SizePosterior:
    """Convert each map draw by Eq 6, with a draw of its coefficients and one of its residual scatter.

    Wellman & Howe (1999) eq. 6, once for each axis. An ellipse turned by an angle takes, along each of its own axes,
    the two head axes' calibrations in the proportion cos^2 to sin^2. The (chain, draw) draws are joint: amplitude and
    width go together (a stronger bump is a narrower one), which must not be lost. `another_exam` is the spread between
    exams of a mass, for `SizePosterior.another_exam`.
    """
    shape, bump = bump.amplitude.shape, bump.flat()
    replicates = even_replicates(bump.amplitude.size) if bump.labels is None else bump.labels
    axes = calibration.x, calibration.y
    by_map = _sizes(bump, axes, [axis.draws.mean(axis=0) for axis in axes])
    points = paired_points(np.maximum(*by_map), replicates, 4, rng)
    coefficients = [
        _coefficients_at(points[:, i], axis, sigma_mm, bump.amplitude)
        for i, (axis, sigma_mm) in enumerate(zip(axes, (bump.sigma_x_mm, bump.sigma_y_mm), strict=True))
    ]
    sizes = _sizes(bump, axes, coefficients)
    z, rho = ndtri(points[:, 2:].T), calibration.residual_correlation
    z[1] = rho * z[0] + np.sqrt(1.0 - rho**2) * z[1]
    valid = (sizes[0] > 0) & (sizes[1] > 0)
    d_x, d_y = (
        np.where(valid, size * np.exp(axis.scatter(bump.amplitude, draws=drawn) * score), np.nan)
        for size, axis, drawn, score in zip(sizes, axes, coefficients, z, strict=True)
    )
    middle, larger = bump.median(), axes[0 if np.nanmedian(by_map[0] - by_map[1]) >= 0 else 1]
    parts = {  # variance of ln(max size) with all but one source held at its centre
        "map": _log_variance(np.maximum(*by_map)),
        "calibration": _log_variance(np.maximum(*_sizes(middle, axes, coefficients))),
        "residual": float(larger.scatter(middle.amplitude)[0] ** 2),
    }
    size = SizePosterior(d_x, d_y, shares(parts), int((~valid).sum()), replicates)
    if another_exam is not None:
        size = replace(size, another_exam=_of_another_exam(size, parts, another_exam, rng))
    return size.reshaped(shape)


def _of_another_exam(
    size: SizePosterior, parts: Mapping[str, float], between: BetweenMaps, rng: np.random.Generator
) -> SizePosterior:
    """The sizes with a further spread between exams, one factor for both axes."""
    points = paired_points(size.max_size_mm, size.replicates, 2, rng)
    tau = between.at(points[:, 0])
    factor = np.exp(tau * ndtri(points[:, 1]))
    return replace(
        size,
        d_x_mm=size.d_x_mm * factor,
        d_y_mm=size.d_y_mm * factor,
        variance_share=shares({**parts, "between_maps": float(np.mean(tau**2))}),
        figures={"between_map_sd": float(np.sqrt(np.mean(tau**2)))},
    )


def _coefficients_at(
    points: FloatArray, axis: AxisCalibration, sigma_mm: FloatArray, amplitude: FloatArray
) -> FloatArray:
    """(n, 6) draws of the coefficients at uniform points, ordered by the size that they give a median map."""
    middle = np.full(len(axis.draws), np.nanmedian(sigma_mm)), np.full(len(axis.draws), np.nanmedian(amplitude))
    in_order = axis.draws[np.argsort(axis.size_mm(*middle, draws=axis.draws), kind="stable")]
    return np.asarray(in_order[(points * len(in_order)).astype(np.intp)])


def _sizes(
    bump: BumpDraws, axes: tuple[AxisCalibration, AxisCalibration], coefficients: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Diameters along the ellipse's own axes, without scatter, by coefficients of the head's two axes."""
    along = np.cos(bump.angle_rad) ** 2

    def blend(sigma_mm: FloatArray, share_x: FloatArray) -> FloatArray:
        across, along_head = (
            axis.size_mm(sigma_mm, bump.amplitude, draws=drawn) for axis, drawn in zip(axes, coefficients, strict=True)
        )
        return share_x * across + (1.0 - share_x) * along_head

    return blend(bump.sigma_x_mm, along), blend(bump.sigma_y_mm, 1.0 - along)


def _log_variance(size_mm: FloatArray) -> float:
    valid = size_mm[size_mm > 0]
    return float(np.var(np.log(valid))) if len(valid) > 1 else 0.0
