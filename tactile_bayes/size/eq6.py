"""Eq 6: diameter of a lump from the width and amplitude of its map, with uncertain coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, field
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.head_shape import HeadShape
from tactile_bayes.presets import Background, Noise
from tactile_bayes.records import dataclass
from tactile_bayes.size import omissions
from tactile_bayes.size.calibration_range import beyond_lumps, outside_domain, too_far

COEFFICIENTS = ("m", "b_mm", "e", "f", "scatter", "scatter_slope")


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a table's maps were built and fitted; a patient's map must agree.

    Parameters
    ----------
    normalise
        As in `MapRecipe`.
    background
        ``"fixed"`` or ``"free"``, as in `FitOptions`.
    radius_mm
        Radius of the fitted window.
    noise
        ``"independent"`` (least squares) or ``"field"``, as in `FitOptions`.
    declared
        True when somebody said so for a table made elsewhere, False when the program made the maps itself.
    flat_field
        Whether the head's own response was taken off, as in `MapRecipe`; None where the table does not say.
    head
        Head that the maps were made with; None where the table does not say.
    """

    normalise: str = "mean"
    background: Background = "fixed"
    radius_mm: float = 20.0
    declared: bool = True
    noise: Noise = "independent"
    flat_field: bool | None = None
    head: HeadShape | None = None

    def differences(
        self,
        *,
        normalise: str,
        background: str,
        radius_mm: float,
        noise: str,
        flat_field: bool | None = None,
        head: HeadShape | None = None,
    ) -> list[str]:
        """Differences from another recipe in words; empty without any. Unknown settings do not differ."""
        pairs = [
            ("normalise", self.normalise, normalise),
            ("background", self.background, background),
            ("fit radius", f"{self.radius_mm:g} mm", f"{radius_mm:g} mm"),
            ("noise", self.noise, noise),
        ]
        if self.flat_field is not None and flat_field is not None:
            words = {True: "on", False: "off"}
            pairs.append(("flat field", words[self.flat_field], words[flat_field]))
        found = [f"{name} {theirs} (the calibration: {ours})" for name, ours, theirs in pairs if ours != theirs]
        return found + self.head_differences(head)

    def head_differences(self, head: HeadShape | None) -> list[str]:
        """In what a map's head departs from the calibration's; empty where one of them is unknown."""
        return [] if self.head is None or head is None else self.head.differences(head)

    @property
    def map_command(self) -> str:
        """The command that makes maps of this recipe from a scan."""
        flat_field = " --flat-field" if self.flat_field else ""
        return f"`map --normalise {self.normalise}{flat_field}`"

    def __str__(self) -> str:
        """The recipe in one line."""
        parts = [f"normalise {self.normalise}", f"background {self.background}", f"fit radius {self.radius_mm:g} mm"]
        parts.append(f"noise {self.noise}")
        if self.flat_field is not None:
            parts.append(f"flat field {'on' if self.flat_field else 'off'}")
        if self.head is not None:
            parts.append(f"head {self.head}")
        return ", ".join(parts)

    def as_dict(self) -> dict[str, object]:
        """Plain data for a calibration's file; unknown settings are left out."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def from_document(cls, document: Mapping[str, Any], *, head: HeadShape | None = None) -> Recipe:
        """Undo `as_dict`; `head` is that of files of earlier versions, which do not name one.

        Raises
        ------
        BadDataError
            When a value cannot be that of a head.
        """
        named = document.get("head")
        return cls(**{**document, "head": head if named is None else HeadShape.from_document(named)})


@dataclass(frozen=True, slots=True, eq=False)
class AxisCalibration:
    r"""Draws of Eq 6's coefficients for the widths along one axis of the head.

    Parameters
    ----------
    draws : (n, 6) array
        m, b (mm), e, f, scatter s and its slope g, see `COEFFICIENTS`. The residual standard deviation of ln d is
        :math:`s\,(a / a_0)^{-g}`: fainter maps tell less.
    reference_amplitude
        :math:`a_0`.
    domain
        Ranges of ``amplitude``, ``sigma_mm`` and ``d_mm`` in the table.
    fit
        Figures of the fit: rows, r2, mean absolute error in percent, whether e was identified.
    """

    draws: FloatArray
    reference_amplitude: float
    domain: Mapping[str, tuple[float, float]]
    fit: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.draws.ndim != 2 or self.draws.shape[1] != len(COEFFICIENTS) or not len(self.draws):
            raise BadDataError(f"draws of an axis have shape {self.draws.shape}", way_out="they must be (n, 6)")
        others = [self.reference_amplitude, *(end for ends in self.domain.values() for end in ends)]
        if not (np.isfinite(self.draws).all() and np.isfinite(others).all()):
            raise BadDataError("an axis holds a number that is not finite", way_out="learn the calibration anew")

    def size_mm(self, sigma_mm: FloatArray, amplitude: FloatArray, *, draws: FloatArray | None = None) -> FloatArray:
        r"""Diameter by Eq 6, without residual scatter: :math:`d = m\,\sigma / (e\,a^f) + b`.

        Parameters
        ----------
        sigma_mm, amplitude : (n,) arrays
        draws : (n, 6) or (6,) array
            Coefficients for each; the mean of the posterior when left out.

        Returns
        -------
        (n,) array of mm
            NaN where the amplitude is not positive.

        Notes
        -----
        Wellman & Howe (1999) eq. 6 with their Delta sigma as a ratio of widths, 1 at one diameter depth.
        """
        use = self.draws.mean(axis=0) if draws is None else draws
        m, b, e, f = (use[..., i] for i in range(4))
        with np.errstate(invalid="ignore", divide="ignore"):
            width_change = e * np.where(amplitude > 0, amplitude, np.nan) ** f
            return np.asarray(m * sigma_mm / width_change + b)

    def scatter(self, amplitude: FloatArray, *, draws: FloatArray | None = None) -> FloatArray:
        """(n,) residual standard deviation of ln d at each amplitude."""
        use = self.draws.mean(axis=0) if draws is None else draws
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(amplitude > 0, amplitude, np.nan) / self.reference_amplitude
            return np.asarray(use[..., 4] * ratio ** -use[..., 5])

    def outside(self, sigma_mm: float, amplitude: float) -> list[str]:
        """Inputs outside the table's range, in words."""
        return outside_domain(self.domain, amplitude, sigma_mm)

    def too_far(self, sigma_mm: float, amplitude: float) -> list[str]:
        """Inputs so far outside that no size is given, in words."""
        return too_far(self.domain, amplitude, sigma_mm)


@dataclass(frozen=True, slots=True)
class LeftOutErrors:
    """Cross-validated errors of sizes, leaving out each geometry of a study in turn.

    Parameters
    ----------
    cases, geometries
        How many were left out.
    least_stiffness_ratio
        Softer lumps took no part.
    eq6, log_quadratic
        Mean absolute error in d, as a share, of Eq 6 and of a quadratic of ln d in ln a and ln sigma: by the widths
        ``"x"`` across the head, ``"y"`` along it, and ``"both"``.
    """

    cases: int
    geometries: int
    least_stiffness_ratio: float
    eq6: Mapping[str, float]
    log_quadratic: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class SizeCalibration:
    """Eq 6 for each axis of the head.

    Parameters
    ----------
    x, y
        Across and along the head. A table with one width calibrates both alike.
    residual_correlation
        Of the residuals of the two axes: a lump that looks large along one tends to look large along both.
    recipe
        How the table's maps were built and fitted.
    axes
        ``("x", "y")``, or ``("both",)`` when the table has one width only.
    left_out
        Errors in geometries left out, where the table was a study.
    cautions
        What of the table's lumps is of one kind, or unlike a patient's, in words.
    """

    x: AxisCalibration
    y: AxisCalibration
    residual_correlation: float
    recipe: Recipe
    axes: tuple[str, ...] = ("x", "y")
    left_out: LeftOutErrors | None = None
    cautions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not -1.0 <= self.residual_correlation <= 1.0:
            raise BadDataError(f"residual_correlation is {self.residual_correlation}", way_out="it must lie in -1 to 1")

    @property
    def fat_mm(self) -> None:
        """Depth of fat of the calibration: None for Eq 6."""

    def at_fat(self, profiles: Sequence[tuple[float, ...] | None]) -> SizeCalibration:
        """Return the calibration unchanged: Eq 6 does not depend on the depth of fat."""
        del profiles
        return self

    def fitting(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float) -> SizeCalibration:
        """Return the calibration unchanged: it is the same for all maps."""
        del amplitude, sigma_x_mm, sigma_y_mm
        return self

    def outside(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float) -> list[str]:
        """In what a map lies or may lie outside the tables of the two axes, in words; empty when it lies inside."""
        by_axis = self._by_axis(self.x.outside(sigma_x_mm, amplitude), self.y.outside(sigma_y_mm, amplitude))
        return [*self.cautions, *by_axis]

    def too_far(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float) -> list[str]:
        """Quantities of a map so far outside the tables that no size is given, in words."""
        return self._by_axis(self.x.too_far(sigma_x_mm, amplitude), self.y.too_far(sigma_y_mm, amplitude))

    def beyond_lumps(self, largest_mm: float) -> list[str]:
        """In what a size lies beyond the tables' lumps, in words; empty when it lies within."""
        return beyond_lumps(self.x.domain, largest_mm)

    @staticmethod
    def _by_axis(x: Sequence[str], y: Sequence[str]) -> list[str]:
        return [f"x: {text}" for text in x] + [f"y: {text}" for text in y]

    def omissions(self) -> list[str]:
        """Sources of error that a size does not contain, in words."""
        return [omissions.ONE_WIDTH] if self.axes == ("both",) else []
