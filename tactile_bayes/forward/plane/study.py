"""The forward study of section 2.4: the Gaussian that each lump's map shows, over sizes, depths and stiffnesses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import FAT_KPA, GLAND_RATIO, POISSON, SEATS, Body
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.plane.condense import CELL_MM, FINENESS, SurfaceCompliance, condense
from tactile_bayes.forward.plane.line import MEAN_KPA, POSITIONS_MM, LineFrames, TactileLine, build_line, slide
from tactile_bayes.geometry import FloatArray

PAPER_DIAMETERS_MM = (5.0, 10.0, 15.0, 20.0, 25.0)
PAPER_DEPTH_RATIOS = (0.6, 0.8, 1.0, 1.2, 1.5, 2.0)
PAPER_STIFFNESS_RATIOS = (2.0, 5.0, 8.0, 10.0, 100.0)
FIT_RADIUS_MM = 48.0
# A bump lower than this share of the background is not called detectable, nor one whose width is not resolved.
DETECTABLE = 0.02
HARD_RATIO = 100.0


@dataclass(frozen=True, slots=True)
class StudySettings:
    """Settings of a study: everything but its cases that the table depends on.

    Parameters
    ----------
    head
        Cross-section of the head.
    mean_kpa
        Force over the head's area.
    poisson, fat_kpa, gland_ratio, thickness_mm
        As in `body.Body`.
    positions_mm
        First and last position of the head and the step between them.
    fit_radius_mm
        Eq 5 is fitted where abs(x) is at most this.
    cell_mm, fineness
        Of the contact and of the mesh, see `condense.condense`.
    """

    head: Head = field(default_factory=Head)
    mean_kpa: float = MEAN_KPA
    poisson: float = POISSON
    fat_kpa: float = FAT_KPA
    gland_ratio: float = GLAND_RATIO
    thickness_mm: float | None = None
    positions_mm: tuple[float, float, float] = POSITIONS_MM
    fit_radius_mm: float = FIT_RADIUS_MM
    cell_mm: float = CELL_MM
    fineness: int = FINENESS

    def as_dict(self) -> dict[str, object]:
        """Plain data for a store's header and for a report."""
        return asdict(self)

    def body(self, d_mm: float, depth_ratio: float, *, seat: float) -> Body:
        """The body of a case."""
        return Body(d_mm, depth_ratio, seat, self.thickness_mm, self.fat_kpa, self.gland_ratio, self.poisson)

    def surface(self, body: Body) -> SurfaceCompliance:
        """The body condensed onto the surface that the head travels over."""
        half_face_mm = 0.5 * self.cell_mm * len(self.head.sensing_cells(self.cell_mm))
        reach = max(abs(self.positions_mm[0]), abs(self.positions_mm[1])) + half_face_mm
        return condense(body, reach_mm=reach, cell_mm=self.cell_mm, fineness=self.fineness)

    def frames(self, surface: SurfaceCompliance, stiffness_ratio: float | None) -> LineFrames:
        """Frames of the head at all its positions."""
        return slide(surface, stiffness_ratio, head=self.head, mean_kpa=self.mean_kpa, positions_mm=self.positions_mm)


@dataclass(frozen=True, slots=True)
class Geometry:
    """Cases with the same geometry, which share one factorisation: one body, several stiffnesses of its lump.

    Parameters
    ----------
    seat, d_mm, depth_ratio
        As in `body.Body`.
    stiffness_ratios
        E2/E1, the lump's modulus over that of fat.
    """

    seat: float
    d_mm: float
    depth_ratio: float
    stiffness_ratios: tuple[float, ...]

    @property
    def key(self) -> str:
        """The item's name in a batch."""
        ratios = "/".join(f"{ratio:g}" for ratio in self.stiffness_ratios)
        return f"seat {self.seat:g}, d {self.d_mm:g} mm, h/d {self.depth_ratio:g}, E2/E1 {ratios}"


@dataclass(frozen=True, slots=True)
class LineFit:
    """The fit of Eq 5 to a line.

    Parameters
    ----------
    amplitude, sigma_mm
        a and sigma of Eq 5.
    rms
        Root mean square of what the Gaussian leaves, in units of the background.
    resolved
        Whether the width lies within what the fit looks at, and not at an end of it.
    """

    amplitude: float
    sigma_mm: float
    rms: float
    resolved: bool = True


Fit = Callable[[TactileLine, float], LineFit]
"""Fits Eq 5 to a line within a radius in mm."""


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One case and the Gaussian its map shows; the fields are the columns of a size table.

    A map in two dimensions has no `sigma_y_mm`. `thickness_mm` (depth of the chest wall), `head_radius_mm` (of its arc)
    and `head` (where its shoulders lie, one of `presets.HEADS`) are what the case was computed with. The rest is the
    recipe of the map: how its frames were normalised, whether its level was ``"fixed"`` at 1 or ``"free"``, the radius
    of the fit, the errors it was fitted under, and whether the head's own response was divided out (None in two
    dimensions, which have none).
    """

    seat: str
    d_mm: float
    depth_ratio: float
    stiffness_ratio: float
    amplitude: float
    sigma_x_mm: float
    fit_rms: float
    detectable: bool
    sigma_y_mm: float | None = None
    thickness_mm: float | None = None
    head_radius_mm: float | None = None
    head: str | None = None
    normalise: str | None = None
    background: str | None = None
    fit_radius_mm: float | None = None
    noise: str | None = None
    flat_field: bool | None = None


def seat_name(seat: float) -> str:
    """``centred``, ``resting`` or the number."""
    return next((name for name, value in SEATS.items() if value == seat), f"{seat:g}")


def paper_grid(seat: float) -> list[Geometry]:
    """The 150 cases of section 2.4 at one seat, as 30 geometries."""
    return [Geometry(seat, d, h, PAPER_STIFFNESS_RATIOS) for d in PAPER_DIAMETERS_MM for h in PAPER_DEPTH_RATIOS]


def group_cases(cases: Iterable[tuple[float, float, float, float]]) -> list[Geometry]:
    """Geometries of cases (seat, d_mm, depth_ratio, stiffness_ratio), in the order in which they first appear.

    Raises
    ------
    BadDataError
        When a case appears twice or cannot be.
    """
    ratios: dict[tuple[float, float, float], list[float]] = {}
    for seat, d, h, ratio in cases:
        known = ratios.setdefault((seat, d, h), [])
        if ratio in known:
            raise BadDataError(
                f"the case seat {seat_name(seat)}, d {d:g} mm, h/d {h:g}, E2/E1 {ratio:g} appears twice",
                way_out="keep it once",
            )
        known.append(ratio)
    return [Geometry(*geometry, tuple(found)) for geometry, found in ratios.items()]


def run_geometry(geometry: Geometry, *, settings: StudySettings, fit: Fit) -> list[StudyRow]:
    """The rows of one geometry.

    Parameters
    ----------
    fit
        How Eq 5 is fitted; importable by name, as `batch` needs it.
    """
    body = settings.body(geometry.d_mm, geometry.depth_ratio, seat=geometry.seat)
    surface = settings.surface(body)
    rows = []
    for ratio in geometry.stiffness_ratios:
        found = fit(build_line(settings.frames(surface, ratio)), settings.fit_radius_mm)
        rows.append(
            StudyRow(
                seat_name(geometry.seat),
                geometry.d_mm,
                geometry.depth_ratio,
                ratio,
                found.amplitude,
                found.sigma_mm,
                found.rms,
                bool(found.amplitude >= DETECTABLE and found.resolved),
                thickness_mm=body.layers.thickness_mm,
                head_radius_mm=settings.head.radius_mm,
                head=settings.head.shoulders,
                normalise="mean",
                background="fixed",
                fit_radius_mm=settings.fit_radius_mm,
                noise="independent",
            )
        )
    return rows


@dataclass(frozen=True, slots=True)
class PrintedEq6:
    """Eq 6 learned in two stages as in the paper, without uncertainty.

    Parameters
    ----------
    m, b_mm
        Line of d on sigma at one diameter depth.
    e, f
        Power law of the width change on the amplitude.
    cases
        Hard, detectable cases that e and f were learned from.
    """

    m: float
    b_mm: float
    e: float
    f: float
    cases: int


def hard_cases(rows: Sequence[StudyRow]) -> list[StudyRow]:
    """The detectable cases of the hardest lumps (E2/E1 = 100, which the paper assumes of all)."""
    return [row for row in rows if row.stiffness_ratio == HARD_RATIO and row.detectable]


def widths(rows: Sequence[StudyRow], *, axis: str = "x") -> FloatArray:
    """(n,) widths across (``"x"``) or along the head (``"y"``; NaN in rows without one)."""
    if axis == "x":
        return np.array([row.sigma_x_mm for row in rows])
    return np.array([np.nan if row.sigma_y_mm is None else row.sigma_y_mm for row in rows])


def width_changes(rows: Sequence[StudyRow], *, axis: str = "x") -> FloatArray:
    """Delta sigma of each row: its width over that of the same lump at one diameter depth; NaN without such a row."""
    sigma = widths(rows, axis=axis)
    lump = [(row.seat, row.d_mm, row.stiffness_ratio) for row in rows]
    level = [abs(row.depth_ratio - 1.0) < 1e-9 for row in rows]
    reference = {key: width for key, width, at in zip(lump, sigma, level, strict=True) if at}
    return np.array([width / reference.get(key, np.nan) for key, width in zip(lump, sigma, strict=True)])


def stiffness_changes(rows: Sequence[StudyRow], *, least_ratio: float = 8.0) -> dict[float, float]:
    """By diameter: largest change of the width at one diameter depth from `least_ratio` on, as a share (Fig 7b).

    The reference is the width at E2/E1 = 100; diameters without two detectable cases have no entry.
    """
    level = [row for row in rows if abs(row.depth_ratio - 1.0) < 1e-9 and row.detectable]
    changes = {}
    for d in sorted({row.d_mm for row in level}):
        sigma = {row.stiffness_ratio: row.sigma_x_mm for row in level if row.d_mm == d}
        others = [value for ratio, value in sigma.items() if least_ratio <= ratio != HARD_RATIO]
        if HARD_RATIO in sigma and others:
            changes[d] = max(abs(value / sigma[HARD_RATIO] - 1.0) for value in others)
    return changes


def learn_as_printed(rows: Sequence[StudyRow], *, axis: str = "x") -> PrintedEq6 | None:
    """Eq 6 in two stages from the hard, detectable cases of one seat; None where they are too few.

    Parameters
    ----------
    axis
        Of the head: ``"x"`` across it, ``"y"`` along it.

    Notes
    -----
    Figure 8: least squares of d on sigma at h/d = 1, and of ln Delta sigma on ln a over all depths.
    """
    hard = hard_cases(rows)
    change = width_changes(hard, axis=axis)
    amplitude = np.array([row.amplitude for row in hard])
    level = [row for row in hard if abs(row.depth_ratio - 1.0) < 1e-9]
    known = np.isfinite(change)
    if len({row.d_mm for row in level}) < 2 or known.sum() < 2 or np.ptp(amplitude[known]) <= 0:
        return None
    m, b = np.polyfit(widths(level, axis=axis), [row.d_mm for row in level], 1)
    f, log_e = np.polyfit(np.log(amplitude[known]), np.log(change[known]), 1)
    return PrintedEq6(float(m), float(b), float(np.exp(log_e)), float(f), int(known.sum()))
