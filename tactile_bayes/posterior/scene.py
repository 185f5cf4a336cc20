"""The scene that a map is read as: a lump, ridges, a level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.field import Templates, Window
from tactile_bayes.posterior.white import WIDEST_IN_RADII

# --- The fit problem that all scenes of one window share: cells, prior and bounds.


class Problem(Record, eq=False):
    """A window with its cells, and the assumptions about a bump in it."""

    window: Window  #: The cells; scenes share one, and with it the noise fields.
    prior: BumpPrior  #: On widths and amplitudes.
    radius_mm: float  #: Radius of the window; bounds the centre about the window's middle.
    amplitude_scale: float = 1.0  #: Unit of the amplitudes' prior, see `bump.value_scale`.
    departure: FloatArray | None = None
    """(k, n) array: Further fixed columns, see `selection.ask_departure`; None for none."""

    @property
    def widest_mm(self) -> float:
        """Upper bound of the widths."""
        return WIDEST_IN_RADII * self.radius_mm


# --- Scenes: the structures that a fit window may hold, with their parameters and prior.
#
# Or a ridge in the bump's place: what a lump's evidence is held against where a ridge is to be feared.

Shape = Literal["round", "ellipse", "rotated", "ridge"]
Neighbour = Literal["second lump", "rib"]
Extra = Literal[Neighbour, ""]
REACH_IN_RADII = 1.5
"""How far from the window's middle a second structure is looked for: beyond its rim a flank still shows."""
APART = 2.0
"""A second lump lies at least this many widths from the first: closer, two Gaussians have one top. A rib may run under
the bump if it is no more than this many times as wide: a wider one is the level's own curve."""
STEP = {
    "u": 0.06,
    "v": 0.06,
    "r": 0.06,
    "x": 0.3,
    "y": 0.3,
    "x2": 0.6,
    "y2": 0.6,
    "w2": 0.15,
    "angle": 0.08,
    "offset": 0.6,
    "along": 0.08,
    "across": 0.6,
}
"""About one posterior standard deviation of each parameter: steps of the search for the mode."""

_BUMP_NAMES: Final[Mapping[Shape, tuple[str, ...]]] = {
    "round": ("u", "x", "y"),
    "ellipse": ("u", "v", "x", "y"),
    "rotated": ("u", "v", "x", "y", "r"),
    "ridge": ("u", "along", "across"),
}
_NEIGHBOUR_NAMES: Final[Mapping[Extra, tuple[str, ...]]] = {
    "": (),
    "second lump": ("x2", "y2", "w2"),
    "rib": ("angle", "offset", "w2"),
}


class Scene(Record):
    """Structures in a model.

    The parameters are ``u, v, x, y`` (logs of the widths while nothing is turned, and the centre), without v for a
    round bump, with r for a turned one; then ``x2, y2, w2`` (centre and log width of a second round lump) or
    ``angle, offset, w2`` (a ridge). A ridge in the bump's place has ``u, along, across``: log width, angle, offset.
    """

    shape: Shape = "ellipse"  #: Shape of the bump.
    tilt: bool = True  #: The level may slope.
    extra: Extra = ""  #: Structure beside the bump.

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shape parameters, the most important first (see `importance`)."""
        return _BUMP_NAMES[self.shape] + _NEIGHBOUR_NAMES[self.extra]

    @property
    def steps(self) -> FloatArray:
        """(p,) typical small step of each parameter."""
        return np.array([STEP[name] for name in self.names])

    def alone(self) -> Scene:
        """Copy without the second structure."""
        return replace(self, extra="")

    def column(self, theta: FloatArray, name: str) -> FloatArray:
        """(...) values of one parameter of (..., p) vectors; those that the scene does not have are 0, v is u."""
        if name in self.names:
            return np.asarray(theta[..., self.names.index(name)])
        return self.column(theta, "u") if name == "v" else np.zeros(theta.shape[:-1])

    def widths(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """p, q, r (see `covariance_from_log_widths`) of (..., p) vectors."""
        u, v = self.column(theta, "u"), self.column(theta, "v")
        return (u + v) / 2.0, (u - v) / 2.0, self.column(theta, "r")

    def carried(self, theta: FloatArray, other: Scene) -> FloatArray:
        """Convert a vector to another scene: shared parameters keep their values, others are 0."""
        p, _, _ = self.widths(theta)
        values = {name: self.column(theta, name) for name in other.names}
        if other.shape == "round":
            values["u"] = p
        return np.array([values[name] for name in other.names])

    @property
    def separable(self) -> bool:
        """True for a scene that is only a bump along the grid's axes: the product of a profile along each."""
        return self.shape in ("round", "ellipse") and not self.extra

    def templates(self, theta: FloatArray, window: Window) -> list[Templates]:
        """Templates of the bump, and of the second structure if there is one, for (m, p) vectors."""
        p, q, r = self.widths(theta)
        if self.shape == "ridge":
            along, across = self.column(theta, "along"), self.column(theta, "across")
            templates: list[Templates] = [window.ridges(along, across, log_width=p)]
        else:
            x, y = self.column(theta, "x"), self.column(theta, "y")
            templates = [window.bumps(x, y, p=p, q=q, r=r if self.shape == "rotated" else None)]
        if self.extra:
            beside = (self.column(theta, name) for name in _NEIGHBOUR_NAMES[self.extra])
            templates.append(neighbour_templates(window, self.extra, *beside))
        return templates

    def log_prior(self, theta: FloatArray, problem: Problem) -> FloatArray:
        """(m,) normalised log prior of the shape; -inf outside the window and where a bump is wider than it."""
        prior, middle, radius_mm = problem.prior, problem.window.middle, problem.radius_mm
        p, q, r = self.widths(theta)
        ratio = np.hypot(q, r)
        total = log_normal_density(p, np.log(prior.width_median_mm), prior.log_width_sd)
        if self.shape == "ridge":
            inside, volume = ridge_place(self.column(theta, "across"), radius_mm)
        else:
            x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
            inside, volume = np.hypot(x, y) <= radius_mm, np.pi * radius_mm**2
        inside, total = inside & (p + ratio <= np.log(problem.widest_mm)), total - np.log(volume)
        if self.shape in ("ellipse", "rotated"):
            # q is half of u - v, p half of their sum: the volume of (u, v) is twice that of (p, q)
            total = total + log_normal_density(q, 0.0, prior.log_ratio_sd) - np.log(2.0)
        if self.shape == "rotated":
            total = total + log_normal_density(r, 0.0, prior.log_ratio_sd)
        if self.extra:
            beside, allowed = self._log_prior_beside(theta, problem)
            total, inside = total + beside, inside & allowed & (self.column(theta, "w2") <= np.log(problem.widest_mm))
        return np.where(inside, total, -np.inf)

    def _log_prior_beside(self, theta: FloatArray, problem: Problem) -> tuple[FloatArray, BoolArray]:
        """Log prior of the second structure (its amplitude's is in the target), and whether its place is allowed."""
        prior, middle, radius_mm = problem.prior, problem.window.middle, problem.radius_mm
        w, reach = self.column(theta, "w2"), REACH_IN_RADII * radius_mm
        total = log_normal_density(w, np.log(prior.width_median_mm), prior.log_width_sd)
        if self.extra == "rib":
            allowed, volume = ridge_place(self.column(theta, "offset"), radius_mm)
            if self.shape != "ridge":
                allowed &= self.rib_apart(theta, middle)
            return total - np.log(volume), allowed
        x2, y2 = self.column(theta, "x2"), self.column(theta, "y2")
        allowed = np.hypot(x2 - middle[0], y2 - middle[1]) <= reach
        if self.shape != "ridge":
            away = np.hypot(x2 - self.column(theta, "x"), y2 - self.column(theta, "y"))
            p, _, _ = self.widths(theta)
            allowed &= away >= APART * np.exp(np.maximum(p, w))
        return total - np.log(np.pi * reach**2), allowed

    def rib_apart(self, theta: FloatArray, middle: tuple[float, float]) -> BoolArray:
        """(m,) whether a rib is clear of the bump, or at most `APART` times as wide."""
        p, _, _ = self.widths(theta)
        return np.asarray(self.rib_clear(theta, middle) | (self.column(theta, "w2") - p <= np.log(APART)))

    def rib_clear(self, theta: FloatArray, middle: tuple[float, float]) -> BoolArray:
        """(m,) whether a rib lies `APART` widths, of it or the bump, from the bump's centre."""
        angle, (p, _, _) = self.column(theta, "angle"), self.widths(theta)
        x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
        away = np.abs(self.column(theta, "offset") - x * np.cos(angle) - y * np.sin(angle))
        return np.asarray(away >= APART * np.exp(np.maximum(p, self.column(theta, "w2"))))


def neighbour_templates(
    window: Window, extra: Neighbour, one: FloatArray, two: FloatArray, log_width: FloatArray
) -> Templates:
    """Templates of m second structures: lumps at ``x2, y2``, or ribs of ``angle, offset``, each an (m,) array."""
    if extra == "rib":
        return window.ridges(one, two, log_width=log_width)
    return window.bumps(one, two, p=log_width, q=np.zeros_like(log_width), r=None)


def ridge_place(offset: FloatArray, radius_mm: float) -> tuple[BoolArray, float]:
    """(m,) whether ridges may lie this far from the window's middle, and the volume of angles and offsets."""
    reach = REACH_IN_RADII * radius_mm
    return np.abs(offset) <= reach, float(np.pi * 2.0 * reach)


def log_normal_density(value: FloatArray, mean: float, sd: float) -> FloatArray:
    """(...) log density of a normal distribution."""
    return np.asarray(-0.5 * ((value - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi)))
