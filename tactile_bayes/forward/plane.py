"""Forward models in two dimensions: plane strain under a head that slides over a lump, and the paper's Eqs 1 to 4."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import toeplitz
from scipy.optimize import minimize_scalar

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, require
from tactile_bayes.forward.axisymmetric import skin_flexibility
from tactile_bayes.forward.contact import FactoredCompliance, solve_contact
from tactile_bayes.forward.mesh import CondensedHole, Mesh, PartStiffness, body_mesh, quadrature, stiffness_factor
from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.forward.tissue import Body, Layers
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.presets import MEAN_KPA

# --- Nearly incompressible plane strain: the elements and their unknowns.

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def plane_part(mesh: Mesh, young_kpa: FloatArray, chosen: BoolArray, *, poisson: float) -> PartStiffness:
    """Stiffness of a mesh's chosen elements, by their Young's moduli; unknowns are ``x0, z0, x1, z1, ...``."""
    elements = mesh.elements[chosen]
    gradient, place, weight = quadrature(mesh.nodes[elements])
    strain = np.zeros((*weight.shape, 3, 9, 2))  # xx, zz, xz
    strain[..., 0, :, 0], strain[..., 1, :, 1] = gradient[..., 0], gradient[..., 1]
    strain[..., 2, :, 0], strain[..., 2, :, 1] = gradient[..., 1], gradient[..., 0]
    factor = stiffness_factor(strain.reshape(*weight.shape, 3, 18), place, weight, normal=2, poisson=poisson)
    stiffness = factor.transpose(0, 2, 1) @ factor * young_kpa[chosen, None, None]
    return PartStiffness.of(elements, stiffness, np.arange(2 * len(mesh.nodes)).reshape(-1, 2))


def _fixed(mesh: Mesh, *, even: bool) -> IndexArray:
    """Unknowns that do not move: at the chest wall, u_x at the body's end, and on the axis u_x (`even`) or u_z."""
    axis, end, base = mesh.edges
    return np.flatnonzero(np.stack([end | base | (axis & even), base | (axis & (not even))], axis=1))


def skin_average(x_mm: FloatArray, *, edges_mm: FloatArray, even: bool) -> FloatArray:
    """(c, k) matrix from displacements of the skin's k nodes, from 0 on, to their averages over c cells.

    By a cubic spline through the nodes, even or odd in x: the elements' own quadratics have jumps of slope, which a
    contact pressure answers with a spike (record 0020).
    """
    k = len(x_mm)
    both = np.concatenate([-x_mm[:0:-1], x_mm])
    centre, half = 0.5 * (edges_mm[1:] + edges_mm[:-1]), 0.5 * np.diff(edges_mm)
    values = CubicSpline(both, np.eye(2 * k - 1))(centre[:, None] + half[:, None] * _POINTS)
    average = np.einsum("cpk,p->ck", values, 0.5 * _WEIGHTS)
    right: FloatArray = average[:, k - 1 :].copy()
    right[:, 1:] += (1.0 if even else -1.0) * average[:, k - 2 :: -1]
    return right


# --- Exact surface response of the layered body without a lump, by Fourier transform along the skin.
#
# A pressure :math:`\cos kx` on the skin pushes it down by :math:`c(k) \cos kx`, with the :math:`c` of a pressure
# :math:`J_0(kr)`. For large k, :math:`c \to 2(1-\nu^2)/(Ek)`, the half-plane of fat.


def surface_compliance(offset_mm: FloatArray, *, cell_mm: float, layers: Layers) -> FloatArray:
    r"""Mean displacement, mm per kPa downwards, of a surface cell under unit pressure on another cell of the same
    width.

    .. math:: C(x) = \frac{\delta}{\pi}\int_0^\infty c(k)\,\mathrm{sinc}^2(k\delta/2) \cos kx \, dk

    The part of :math:`c` that falls off slowly, :math:`A(1-e^{-kb})/k`, is integrated in closed form (the half-plane's
    logarithm, averaged over both cells); the rest falls off as :math:`e^{-2kb}` and takes Gauss's rule.
    """
    layers_tail = 2 * (1 - layers.poisson**2) / layers.fat_kpa
    depth = layers.fat_mm
    offset = np.abs(np.asarray(offset_mm, dtype=np.float64))
    k, weight = _wave_numbers(depth, layers.thickness_mm, reach_mm=float(offset.max(initial=0.0)) + cell_mm)
    rest = skin_flexibility(k, layers)[:, 1, 1] + layers_tail * np.expm1(-k * depth) / k
    rest *= weight * np.sinc(k * cell_mm / (2 * np.pi)) ** 2
    smooth = cell_mm / np.pi * np.cos(np.outer(offset, k)) @ rest
    # integral of (1 - e^-kb)/k cos kx over k, i.e. 0.5 ln(1 + b^2/x^2), averaged over both cells, times the width
    steps = offset[:, None] + cell_mm * np.array([-1.0, 0.0, 1.0])
    difference = _log_primitive(steps, depth) - _log_primitive(steps, 0.0)
    log_average = 0.5 * difference @ np.array([1.0, -2.0, 1.0]) / cell_mm
    return np.asarray(smooth + layers_tail * log_average / np.pi)


def _wave_numbers(depth_mm: float, thickness_mm: float, *, reach_mm: float) -> tuple[FloatArray, FloatArray]:
    """Gauss points and weights on (0, 40 / depth), in panels that follow 1/thickness and the cosine's period."""
    end = 40.0 / depth_mm
    panels = [0.0]
    while panels[-1] < end:
        panels.append(min(end, panels[-1] + min(max(0.5 / thickness_mm, 0.5 * panels[-1]), 6.0 / reach_mm)))
    points, weights = np.polynomial.legendre.leggauss(8)
    low, high = np.array(panels[:-1])[:, None], np.array(panels[1:])[:, None]
    return (0.5 * (low + high + (high - low) * points)).reshape(-1), (0.5 * (high - low) * weights).reshape(-1)


def _log_primitive(x: FloatArray, b: float) -> FloatArray:
    """Second antiderivative of ln(x^2 + b^2)."""
    square = x**2 + b**2
    log = np.log(np.where(square > 0, square, 1.0))
    angle = np.arctan(x / b) if b > 0 else 0.0
    return np.asarray(0.5 * (x**2 - b**2) * log + 2 * b * x * angle - 1.5 * x**2)


# --- Static condensation of a body with a lump onto its surface and the lump's boundary.
#
# The skin's compliance is the exact one of the layers (`surface_compliance`), and its change by a hole that is filled
# with the lump instead of the layers' own tissue (`mesh.CondensedHole`): one factorisation per geometry gives every
# stiffness ratio (record 0021). The body is symmetric: half of it is solved for loads even and odd in x.

FINENESS = 2
CELL_MM = 0.25


class SurfaceCompliance(Record, eq=False):
    """Mean vertical displacement of each surface cell per unit pressure on each cell, for one geometry."""

    body: Body
    edges_mm: FloatArray  #: (n + 1,) array, symmetric about the lump's axis.
    row: FloatArray  #: (n,) array: first row of the (Toeplitz) matrix of the body without the lump, mm per kPa.
    even: CondensedHole
    odd: CondensedHole  #: `even`, `odd`: The body on x > 0, for loads symmetric and antisymmetric in x.

    @property
    def cell_mm(self) -> float:
        """Width of the cells."""
        return float(self.edges_mm[1] - self.edges_mm[0])

    def without_lump(self) -> FloatArray:
        """(n, n) compliance of the layers alone."""
        return np.asarray(toeplitz(self.row))

    def with_lump(self, stiffness_ratio: float) -> FloatArray:
        """(n, n) compliance with a lump of E2/E1 = `stiffness_ratio`, symmetric and positive definite."""
        require(0 < stiffness_ratio < np.inf, "stiffness_ratio", stiffness_ratio, "be finite and above 0")
        even, odd = (hole.change(stiffness_ratio * self.body.fat_kpa) for hole in (self.even, self.odd))
        same_side, other_side = even + odd, even - odd
        change = np.block([[same_side[::-1, ::-1], other_side[::-1]], [other_side[:, ::-1], same_side]])
        # each half carries half of a load, and force is pressure times width
        return np.asarray(self.without_lump() + 0.5 * self.cell_mm * change)


def condense(
    body: Body, *, reach_mm: float = 72.0, cell_mm: float = CELL_MM, fineness: int = FINENESS
) -> SurfaceCompliance:
    """Condense a body onto cells of its skin from ``-reach_mm`` to ``reach_mm``, rounded up to whole cells."""
    count = int(np.ceil(reach_mm / cell_mm - 1e-9))
    half: FloatArray = cell_mm * np.arange(count + 1.0)
    row = surface_compliance(2 * half[-1] * np.arange(2 * count) / (2 * count), cell_mm=cell_mm, layers=body.layers)
    cut = body.seat < 1.0 and body.gland_ratio != 1.0  # the fat-gland boundary cuts the lump
    mesh = body_mesh(body, fineness=fineness, layered=cut)
    plain = body_mesh(body, fineness=fineness, layered=False) if cut else mesh
    modulus = np.where(mesh.gland, body.gland_ratio, 1.0) * body.fat_kpa
    outside, inside = (plane_part(mesh, modulus, chosen, poisson=body.poisson) for chosen in (~mesh.lump, mesh.lump))
    unit = plane_part(plain, np.ones(len(plain.elements)), plain.lump, poisson=body.poisson)
    skin, holes = mesh.skin, []
    rim, plain_rim = ((2 * nodes[:, None] + np.arange(2)).ravel() for nodes in (mesh.rim, plain.rim))
    for even in (True, False):
        fixed = _fixed(mesh, even=even)
        flexibility, sinking = outside.without(fixed).hole_flexibility(rim, 2 * skin + 1)
        average = skin_average(mesh.nodes[skin, 0], edges_mm=half, even=even)
        lump = unit.without(_fixed(plain, even=even)).condensed_on(plain_rim)
        original = inside.without(fixed).condensed_on(rim)
        holes.append(CondensedHole(flexibility, average @ sinking, lump, original))
    return SurfaceCompliance(body, np.concatenate([-half[:0:-1], half]), row, *holes)


# --- Frames of a head that slides over the lump in two dimensions, and the map they average to.
#
# The head stands at equal steps, and a cell of the map is as wide as a step. Far from the lump a cell collects the
# head's profile at equal distances over its width, each once: its mean is that of a frame, 1 after normalising.

POSITIONS_MM = (-60.0, 60.0, 0.5)
_NOMINAL_HEAD = HeadSection()


class LineFrames(Record, eq=False):
    """Pressure across the head at each of its positions."""

    x_c_mm: FloatArray  #: (m,) array: Centre of the head, from the lump's axis.
    s_mm: FloatArray  #: (n,) array: Centres of the cells from the head's centre.
    pressure_kpa: FloatArray  #: (m, n) array.

    @property
    def cell_mm(self) -> float:
        """Width of a cell of the head."""
        return float(self.s_mm[1] - self.s_mm[0])

    def at(self, x_c_mm: float) -> FloatArray:
        """(n,) frame at the position nearest to `x_c_mm`."""
        return np.asarray(self.pressure_kpa[int(np.argmin(np.abs(self.x_c_mm - x_c_mm)))])

    def as_taxels(self, pitch_mm: float) -> LineFrames:
        """The same frames as sensors of width `pitch_mm` measure them: means over whole cells."""
        group = round(pitch_mm / self.cell_mm)
        fits = abs(group * self.cell_mm - pitch_mm) <= 1e-9 and not len(self.s_mm) % group
        require(fits, "pitch_mm", pitch_mm, f"hold whole cells of {self.cell_mm:g} mm and fill the head")
        means = self.pressure_kpa.reshape(len(self.x_c_mm), -1, group).mean(axis=2)
        return LineFrames(self.x_c_mm, self.s_mm.reshape(-1, group).mean(axis=1), means)


class TactileLine(Record, eq=False):
    """One-dimensional tactile map: the counterpart of `TactileMap` for a line."""

    x_mm: FloatArray  #: (k,) array: Centres of the map's cells.
    mean: FloatArray  #: (k,) array: Mean of the readings in a cell; NaN without any.
    count: np.ndarray[tuple[int, ...], np.dtype[np.int64]]  #: (k,) int array.
    cell_mm: float  #: Width of the map's cells.


def head_positions(positions_mm: tuple[float, float, float] = POSITIONS_MM) -> FloatArray:
    """(m,) positions of the head at equal steps from first to last, both included."""
    first, last, step = positions_mm
    return np.asarray(first + step * np.arange(round((last - first) / step) + 1), dtype=np.float64)


def press(
    surface: SurfaceCompliance,
    stiffness_ratio: float | None,
    x_c_mm: FloatArray,
    *,
    head: HeadSection = _NOMINAL_HEAD,
    mean_kpa: float | FloatArray = MEAN_KPA,
) -> LineFrames:
    """Frames of a head at (m,) positions `x_c_mm`, pressed with one or (m,) mean pressures over the sensing width.

    A `stiffness_ratio` (E2/E1) of None is the body without a lump. Shoulders outside the sensing cells press and are
    not in the frames.
    """
    cell = surface.cell_mm
    profile, senses = head.cell_profile_mm(cell), head.sensing_cells(cell)
    first = (np.asarray(x_c_mm) - 0.5 * cell * len(profile) - surface.edges_mm[0]) / cell
    if first.min() < -1e-9 or first.max() > len(surface.row) - len(profile) + 1e-9:
        raise BadDataError(
            f"the head at {np.abs(x_c_mm).max():g} mm leaves the surface, which ends at {surface.edges_mm[-1]:g} mm",
            way_out="condense the body with a larger reach_mm",
        )
    matrix = surface.without_lump() if stiffness_ratio is None else surface.with_lump(stiffness_ratio)
    level = np.broadcast_to(np.asarray(mean_kpa, dtype=np.float64), (len(first),))
    pressure, touching = np.empty((len(first), int(senses.sum()))), None
    for i, (begin, kpa) in enumerate(zip(first.tolist(), level.tolist(), strict=True)):
        stiffness = FactoredCompliance.of(_window(matrix, begin, len(profile)))
        contact = solve_contact(stiffness, profile, mean_kpa=kpa, counted=senses, touching=touching)
        pressure[i], touching = contact.pressure_kpa[senses], contact.touching
    return LineFrames(np.asarray(x_c_mm, dtype=np.float64), _cell_centres(pressure.shape[1], cell), pressure)


def press_layers(
    layers: Layers,
    *,
    head: HeadSection = _NOMINAL_HEAD,
    mean_kpa: float | FloatArray = MEAN_KPA,
    cell_mm: float = CELL_MM,
) -> LineFrames:
    """Frames of a body without a lump, P1, one per mean pressure, wherever the head is."""
    profile, senses = head.cell_profile_mm(cell_mm), head.sensing_cells(cell_mm)
    row = surface_compliance(np.asarray(cell_mm * np.arange(len(profile))), cell_mm=cell_mm, layers=layers)
    stiffness = FactoredCompliance.of(np.asarray(toeplitz(row)))
    level = np.atleast_1d(np.asarray(mean_kpa, dtype=np.float64))
    contacts = [solve_contact(stiffness, profile, mean_kpa=kpa, counted=senses) for kpa in level.tolist()]
    pressure = np.stack([contact.pressure_kpa[senses] for contact in contacts])
    return LineFrames(np.zeros(len(level)), _cell_centres(pressure.shape[1], cell_mm), pressure)


def _cell_centres(count: int, cell_mm: float) -> FloatArray:
    """(count,) centres of the head's cells from its own centre."""
    return np.asarray(cell_mm * (np.arange(count) - 0.5 * (count - 1)), dtype=np.float64)


def _window(matrix: FloatArray, first: float, n: int) -> FloatArray:
    """(n, n) diagonal block that begins at `first`; between two cells the weighted mean of both blocks."""
    low = int(np.clip(np.floor(first + 1e-9), 0, len(matrix) - n))
    share, block = first - low, matrix[low : low + n, low : low + n]
    if abs(share) <= 1e-9:
        return block
    return np.asarray(block + share * (matrix[low + 1 : low + 1 + n, low + 1 : low + 1 + n] - block))


def slide(
    surface: SurfaceCompliance,
    stiffness_ratio: float | None,
    *,
    head: HeadSection = _NOMINAL_HEAD,
    mean_kpa: float = MEAN_KPA,
    positions_mm: tuple[float, float, float] = POSITIONS_MM,
) -> LineFrames:
    """Frames of a head that slides across the lump; mirrored positions are solved once."""
    x_c = head_positions(positions_mm)
    if not np.allclose(x_c, -x_c[::-1], rtol=0, atol=1e-9):
        return press(surface, stiffness_ratio, x_c, head=head, mean_kpa=mean_kpa)
    half = press(surface, stiffness_ratio, x_c[len(x_c) // 2 :], head=head, mean_kpa=mean_kpa)
    mirrored = half.pressure_kpa[::-1, ::-1][: len(x_c) // 2]
    return LineFrames(x_c, half.s_mm, np.concatenate([mirrored, half.pressure_kpa]))


def build_line(frames: LineFrames) -> TactileLine:
    """Average frames over their means, at equal steps, in cells as wide as a step, with edges at multiples of it."""
    step = float(frames.x_c_mm[1] - frames.x_c_mm[0])
    values = frames.pressure_kpa / frames.pressure_kpa.mean(axis=1, keepdims=True)
    place = (frames.x_c_mm[:, None] + frames.s_mm[None, :]) / step
    number = np.floor(place + 1e-9).astype(np.int64)
    low = int(number.min())
    count = np.bincount((number - low).reshape(-1))
    total = np.bincount((number - low).reshape(-1), weights=values.reshape(-1))
    with np.errstate(invalid="ignore"):
        mean = total / np.where(count > 0, count, np.nan)
    x: FloatArray = step * (low + np.arange(float(len(count))) + 0.5)
    return TactileLine(x, mean, count.astype(np.int64), step)


# --- The empirical model of section 2.2: frames as a weighted sum of two pressure distributions (Eqs 1 to 4).
#
# Symbols as in the paper, except that its three meanings of *a* have names of their own: `SHARE` (alpha, 0.5), the
# curvature :math:`1/a(t)^2` of the homogeneous profile, and the map's amplitude, which is not part of this model.

SHARE = 0.5  #: alpha: share of the homogeneous profile that is subtracted over the lump (P2 = P0 - alpha P1).

DEEPEST_RATIO, LEAST_D_MM = 1.0, 10.0
"""Largest h/d and least diameter in mm for which the map of Eqs 1 to 4 has a lump about as high and wide as plane
strain: amplitude -33 to +56 %, width -31 to +59 % (record 0098)."""
LOST_RATIO = 1.5  #: h/d from which the map of Eqs 1 to 4 has lost most lumps (record 0098).
RANGE = f"it holds for cylinders of {LEAST_D_MM:g} mm and more down to h/d {DEEPEST_RATIO:g}"


def outside_range(d_mm: float, depth_ratio: float) -> str | None:
    """Line of warning for a lump outside the empirical model's range (record 0098); None inside it."""
    if depth_ratio > DEEPEST_RATIO:
        fault = "loses most lumps" if depth_ratio >= LOST_RATIO else "makes lumps too low and wide, or loses them"
        return f"warning: h/d {depth_ratio:g}: the empirical model {fault} at this depth; {RANGE} (use plane-strain)"
    if d_mm < LEAST_D_MM:
        return f"warning: d {d_mm:g} mm: the empirical model makes it too wide; {RANGE} (use plane-strain)"
    return None


def lump_pressure(x_mm: FloatArray, *, height_kpa: float, width_mm: float) -> FloatArray:
    r"""Pressure that the lump adds at a point of the skin, P2 (Eq 2).

    .. math:: P_2(x) = g \exp(-x^2 / (2 \sigma^2))

    Wellman & Howe (1999) eq. 2; the printed s is sigma.
    """
    return np.asarray(height_kpa * np.exp(-0.5 * (np.asarray(x_mm) / width_mm) ** 2))


def fit_lump_pressure(x_mm: FloatArray, data: FloatArray, *, widths_mm: tuple[float, float]) -> tuple[float, float]:
    """Height and width (mm) of the Gaussian of Eq 2 by least squares, its width between the two given."""
    low, high = np.log(widths_mm)

    def shape(log_width: float) -> FloatArray:
        return lump_pressure(x_mm, height_kpa=1.0, width_mm=float(np.exp(log_width)))

    fit = fit_shape(shape, data, grid=np.linspace(low, high, 60))
    return fit.height, float(np.exp(fit.parameter))


def kappa(x_c_mm: FloatArray, *, d_mm: float) -> FloatArray:
    r"""Share of the homogeneous profile that stays under the head at a distance from the lump.

    .. math:: \kappa(x_c, d) = \min\left(1, \tfrac12 \left(1 + \tfrac{3}{8d} |x_c|\right)\right)

    Wellman & Howe (1999) eq. 4 with the slope turned over, so that it is continuous: decision record 0004.
    """
    return np.minimum(1.0, 0.5 * (1.0 + 3.0 / (8.0 * d_mm) * np.abs(np.asarray(x_c_mm, dtype=np.float64))))


class EmpiricalModel(Record):
    """Fitted parameters of one case."""

    peak_kpa: float
    curvature_per_mm2: float
    """`peak_kpa`, `curvature_per_mm2`: :math:`P_o(t)` and :math:`1/a(t)^2` of the homogeneous profile (Eq 1): positive
    for a profile that falls off to the sides, negative for one that rises."""
    height_kpa: float
    width_mm: float  #: `height_kpa`, `width_mm`: g and sigma of Eq 2.
    d_mm: float  #: Diameter of the lump.
    half_width_mm: float  #: Of the head.

    def homogeneous(self, s_mm: FloatArray) -> FloatArray:
        r"""Pressure across the head far from the lump, P1 (Eq 1); 0 outside the head and where the root would be
        imaginary.

        .. math:: P_1(s) = P_o \sqrt{1 - s^2 / a^2}

        Wellman & Howe (1999) eq. 1, after Hertz (Johnson 1985, section 4.2). On thick tissue the pressure under this
        head rises to its sides, which no real a describes: the square may have either sign.
        """
        s = np.asarray(s_mm, dtype=np.float64)
        inside = np.maximum(1.0 - self.curvature_per_mm2 * s**2, 0.0)
        return np.where(np.abs(s) <= self.half_width_mm, self.peak_kpa * np.sqrt(inside), 0.0)

    def surface_pressure(self, s_mm: FloatArray, x_c_mm: FloatArray) -> FloatArray:
        r"""Pressure at position s on the head whose centre is at x_c; the arguments broadcast.

        .. math:: P(x, s) = P_2(x) (P_1(s) / \max P_1)^2 + \kappa(x_c, d) P_1(s), \quad x = s + x_c

        Wellman & Howe (1999) eq. 3.
        """
        p1 = self.homogeneous(s_mm)
        # The largest P1 is at the centre, or at the sides where it rises to them.
        share = p1 / float(self.homogeneous(np.array([0.0, self.half_width_mm])).max())
        bump = lump_pressure(s_mm + x_c_mm, height_kpa=self.height_kpa, width_mm=self.width_mm)
        return np.asarray(bump * share**2 + kappa(x_c_mm, d_mm=self.d_mm) * p1)

    def frames(self, x_c_mm: FloatArray, s_mm: FloatArray) -> LineFrames:
        """Frames at the given positions; `build_line` averages their curves to the map."""
        return LineFrames(x_c_mm, s_mm, self.surface_pressure(s_mm[None, :], x_c_mm[:, None]))


def fit_empirical(
    s_mm: FloatArray, far_kpa: FloatArray, centred_kpa: FloatArray, *, d_mm: float, half_width_mm: float
) -> EmpiricalModel:
    """Fit Eqs 1 and 2 to a frame far from the lump (Fig 5a) and one centred over it (P0, Fig 5b); `d_mm` is Eq 4's."""
    if len(s_mm) < 4 or not (far_kpa > 0).any():
        raise BadDataError(f"a frame of {len(s_mm)} cells", way_out="give at least 4, some of them above 0 kPa")

    def profile(scaled: float) -> FloatArray:
        curvature = scaled / half_width_mm**2
        return EmpiricalModel(1.0, curvature, 0.0, 1.0, d_mm, half_width_mm).homogeneous(s_mm)

    # 1 is the profile that falls to 0 at the sides; far below -8 the middle would be a small part of the sides
    far = fit_shape(profile, far_kpa, grid=np.linspace(-8.0, 1.0, 31))
    every_width = 0.5 * float(s_mm[1] - s_mm[0]), 10.0 * float(np.abs(s_mm).max())  # that a frame can show
    added = centred_kpa - SHARE * (far.height * profile(far.parameter))
    height, width = fit_lump_pressure(s_mm, added, widths_mm=every_width)
    return EmpiricalModel(far.height, far.parameter / half_width_mm**2, height, width, d_mm, half_width_mm)


class ShapeFit(Record):
    """Best multiple of a shape: its height, the shape's parameter and the residual sum of squares."""

    height: float
    parameter: float
    sse: float


def fit_shape(shape: Callable[[float], FloatArray], data: FloatArray, *, grid: FloatArray) -> ShapeFit:
    """Least squares of ``height * shape(parameter)``: the lowest minimum between the ends of an increasing grid.

    The height is eliminated (variable projection; Golub & Pereyra 1973). Gauss-Newton steps do not settle where the
    shape leaves more of the data than it explains, as a faint bump in its trough does.
    """

    def residual(parameter: float) -> float:
        return fit_height(shape(parameter), data)[1]

    k = int(np.argmin([residual(value) for value in grid]))
    bounds = (grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)])
    refined = float(minimize_scalar(residual, bounds=bounds, method="bounded", options={"xatol": 1e-11}).x)
    best = min((refined, float(grid[k])), key=residual)
    height, sse = fit_height(shape(best), data)
    return ShapeFit(height, best, sse)


def fit_height(shape: FloatArray, data: FloatArray) -> tuple[float, float]:
    """Best multiple of `shape`, and the residual sum of squares of `data`."""
    height = float(shape @ data / (shape @ shape))
    return height, float(np.sum((data - height * shape) ** 2))
