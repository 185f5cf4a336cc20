"""The paper's forward study on a line, lookalike frames, and the head that presses most evenly."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from tactile_bayes.declarations import Record, as_dict, field, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward import plane
from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.forward.tissue import SEATS, Body, Layers
from tactile_bayes.geometry import FloatArray
from tactile_bayes.options import CaseOptions, TissueOptions
from tactile_bayes.posterior.bump import cell_mean_gaussian
from tactile_bayes.posterior.white import LEAST_WIDTH_IN_CELLS, WIDEST_IN_RADII
from tactile_bayes.presets import HEAD_PITCH_MM, HEADS, SHOULDERS_INSIDE
from tactile_bayes.size.learn import eq6

# --- The forward study of section 2.4: the Gaussian that each lump's map shows, over sizes, depths and stiffnesses.

PAPER_DIAMETERS_MM = (5.0, 10.0, 15.0, 20.0, 25.0)
PAPER_DEPTH_RATIOS = (0.6, 0.8, 1.0, 1.2, 1.5, 2.0)
PAPER_STIFFNESS_RATIOS = (2.0, 5.0, 8.0, 10.0, 100.0)
FIT_RADIUS_MM = 48.0
# A bump is detectable if it is at least this share of the background high and its width is resolved.
DETECTABLE = 0.02
HARD_RATIO = 100.0
_NO_CHANGE_MM = 1e6  #: The line is a map that does not change in y: a bump of this width there.


class CaseSettings(CaseOptions, kw_only=True):
    """Head, pressure and tissue of a study in two or three dimensions."""

    head: Any = None

    def as_dict(self) -> dict[str, object]:
        """Plain data for a store's header and for a report."""
        return as_dict(self)

    def body(self, d_mm: float, depth_ratio: float, *, seat: float) -> Body:
        """The body of a case."""
        return Body(d_mm, depth_ratio, seat, self.thickness_mm, self.fat_kpa, self.gland_ratio, self.poisson)

    def maps(self, body: Body) -> Callable[[float], Any]:
        """Function from the lump's stiffness ratio to its map; the part that all ratios share is computed here."""
        raise NotImplementedError

    def fitted(self, tactile_map: Any) -> MapFit:
        """The Gaussian of a map."""
        raise NotImplementedError

    def recipe(self) -> dict[str, Any]:
        """How maps are made and fitted, as columns of `StudyRow`."""
        raise NotImplementedError

    def rows(self, geometry: Geometry) -> list[StudyRow]:
        """The rows of one geometry; the body is condensed once for all stiffnesses of its lump."""
        body = self.body(geometry.d_mm, geometry.depth_ratio, seat=geometry.seat)
        case = seat_name(geometry.seat), geometry.d_mm, geometry.depth_ratio
        setting = body.layers.thickness_mm, self.head.radius_mm, self.head.shoulders
        maps, rows, recipe = self.maps(body), [], {"normalise": "mean", "noise": "independent", **self.recipe()}
        for ratio in geometry.stiffness_ratios:
            fit = self.fitted(maps(ratio))
            a, (sigma_x, sigma_y) = fit.amplitude, fit.widths_mm
            detectable = bool(a >= DETECTABLE and fit.resolved)
            rows.append(StudyRow(*case, ratio, a, sigma_x, fit.rms, detectable, sigma_y, *setting, **recipe))
        return rows


class StudySettings(CaseSettings, kw_only=True):
    """Settings of a study: all that its table depends on besides its cases."""

    head: HeadSection = field(default_factory=HeadSection)  #: Cross-section of the head.
    positions_mm: tuple[float, float, float] = plane.POSITIONS_MM
    """First and last position of the head and the step between them."""
    fit_radius_mm: float = FIT_RADIUS_MM  #: Eq 5 is fitted where abs(x) is at most this.
    cell_mm: float = plane.CELL_MM  #: Of the contact, see `plane.condense`.

    def recipe(self) -> dict[str, Any]:
        return {"background": "fixed", "fit_radius_mm": self.fit_radius_mm}

    def maps(self, body: Body) -> Callable[[float], plane.TactileLine]:
        surface = self.surface(body)
        return lambda ratio: plane.build_line(self.frames(surface, ratio))

    def fitted(self, line: plane.TactileLine) -> MapFit:
        return fit_line(line, self.fit_radius_mm)

    def surface(self, body: Body) -> plane.SurfaceCompliance:
        """The body condensed onto the surface that the head travels over."""
        half_face_mm = 0.5 * self.cell_mm * len(self.head.sensing_cells(self.cell_mm))
        reach = max(abs(self.positions_mm[0]), abs(self.positions_mm[1])) + half_face_mm
        return plane.condense(body, reach_mm=reach, cell_mm=self.cell_mm, fineness=self.fineness)

    def frames(self, surface: plane.SurfaceCompliance, stiffness_ratio: float | None) -> plane.LineFrames:
        """Frames of the head at all its positions."""
        return plane.slide(
            surface, stiffness_ratio, head=self.head, mean_kpa=self.mean_kpa, positions_mm=self.positions_mm
        )

    def over(self, surface: plane.SurfaceCompliance, stiffness_ratio: float = HARD_RATIO) -> plane.LineFrames:
        """The frame with the head's centre over the lump."""
        return plane.press(surface, stiffness_ratio, np.zeros(1), head=self.head, mean_kpa=self.mean_kpa)

    def over_lump(self, body: Body) -> plane.LineFrames:
        """The frame with the head's centre over a hard lump."""
        return self.over(self.surface(body))

    def far(self, layers: Layers) -> plane.LineFrames:
        """The frame far from any lump."""
        return plane.press_layers(layers, head=self.head, mean_kpa=self.mean_kpa, cell_mm=self.cell_mm)

    def empirical(self, d_mm: float, layers: Layers, over: plane.LineFrames) -> plane.EmpiricalModel:
        """The empirical model, fitted to the taxels' frames far from a lump and `over` it."""
        taxels, far = over.as_taxels(HEAD_PITCH_MM), self.far(layers).as_taxels(HEAD_PITCH_MM)
        half_width = self.head.half_width_mm
        return plane.fit_empirical(taxels.s_mm, far.at(0.0), taxels.at(0.0), d_mm=d_mm, half_width_mm=half_width)


class Geometry(Record):
    """Cases with the same geometry, which share one factorisation: one body, several stiffnesses of its lump."""

    seat: float
    d_mm: float
    depth_ratio: float  #: These as in `tissue.Body`.
    stiffness_ratios: tuple[float, ...]  #: E2/E1, the lump's modulus over that of fat.

    @property
    def key(self) -> str:
        """The item's name in a batch."""
        ratios = "/".join(f"{ratio:g}" for ratio in self.stiffness_ratios)
        return f"seat {self.seat:g}, d {self.d_mm:g} mm, h/d {self.depth_ratio:g}, E2/E1 {ratios}"


class MapFit(Record):
    """The fit of Eq 5 to a line, or of Eq 7 to a map."""

    amplitude: float  #: a: height above the level, in units of the map.
    widths_mm: tuple[float, float | None]  #: Sigma across and along the head; a line has no width along it.
    rms: float  #: Root mean square residual, in units of the background.
    resolved: bool = True  #: True if array and window resolve the widths, and none is at an end of its range.


def fit_line(line: plane.TactileLine, radius_mm: float) -> MapFit:
    """Fit Eq 5 with background 1 and the bump on the lump's axis, averaged over cells as for a patient's map.

    Widths range from half a cell to three quarters of the radius, also as for a patient's map; a bump that runs to
    either end is reported there.
    """
    inside = (np.abs(line.x_mm) <= radius_mm) & (line.count > 0)
    x, excess = line.x_mm[inside], line.mean[inside] - 1.0

    def bump(log_width: float) -> FloatArray:
        covariance = np.diag([np.exp(2 * log_width), _NO_CHANGE_MM**2])
        return cell_mean_gaussian(x, np.zeros_like(x), covariance_mm2=covariance, cell_mm=line.cell_mm)

    ends = np.log([LEAST_WIDTH_IN_CELLS * line.cell_mm, WIDEST_IN_RADII * radius_mm])
    fit = plane.fit_shape(bump, excess, grid=np.linspace(ends[0], ends[1], 60))
    resolved = bool(ends[0] + 1e-6 < fit.parameter < ends[1] - 1e-6)
    width = float(np.exp(fit.parameter))
    return MapFit(fit.height, (width, None), float(np.sqrt(fit.sse / len(x))), resolved)


class StudyRow(Record):
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
    """Group cases (seat, d_mm, depth_ratio, stiffness_ratio) into geometries, in the order in which these first appear;
    `BadDataError` if a case appears twice."""
    ratios: dict[tuple[float, float, float], list[float]] = {}
    for seat, d, h, ratio in cases:
        listed = ratios.setdefault((seat, d, h), [])
        if ratio in listed:
            raise BadDataError(
                f"the case seat {seat_name(seat)}, d {d:g} mm, h/d {h:g}, E2/E1 {ratio:g} appears twice",
                way_out="keep it once",
            )
        listed.append(ratio)
    return [Geometry(*geometry, tuple(listed)) for geometry, listed in ratios.items()]


class PrintedEq6(Record):
    """Eq 6 learned in two stages as in the paper, without uncertainty."""

    m: float
    b_mm: float  #: `m`, `b_mm`: Line of d on sigma at one diameter depth.
    e: float
    f: float  #: `e`, `f`: Power law of the width change on the amplitude.
    cases: int  #: Number of hard, detectable cases that e and f were learned from.


def hard_cases(rows: Sequence[StudyRow]) -> list[StudyRow]:
    """The detectable cases of the hardest lumps (E2/E1 = 100, which the paper assumes of all)."""
    return [row for row in rows if row.stiffness_ratio == HARD_RATIO and row.detectable]


def widths(rows: Sequence[StudyRow], *, axis: str = "x") -> FloatArray:
    """(n,) widths across (``"x"``) or along the head (``"y"``; NaN in rows without one)."""
    return np.array([getattr(row, f"sigma_{axis}_mm") for row in rows], dtype=np.float64)


def width_changes(rows: Sequence[StudyRow], *, axis: str = "x") -> FloatArray:
    """Delta sigma of each row: its width over that of the same lump at one diameter depth; NaN without such a row."""
    lump = [(row.seat, row.d_mm, row.stiffness_ratio) for row in rows]
    depth_ratio = np.array([row.depth_ratio for row in rows])
    return eq6.width_changes(widths(rows, axis=axis), depth_ratio=depth_ratio, group=lump)


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
    """Learn Eq 6 in two stages from the hard, detectable cases of one seat; None where they are too few.

    Figure 8: least squares of d on sigma at h/d = 1, and of ln Delta sigma on ln a over all depths. The sigma is along
    the head's `axis`, ``"x"`` across it.
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


# --- Lumps of different size whose frames look alike (Fig 5b of the paper), searched over sizes and depths.
#
# The paper says that some combinations of size and depth lead to identical pressure distributions over the lump.
# The difference of two frames is taken relative to the pressure that the lump adds: frames of two faint lumps are
# alike because both are those of no lump.

DEPTH_RATIOS = (0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5)
LEAST_RISE = 0.1
"""A lump takes part when it raises the middle of the head by this share of the frame's mean: five times the noise."""
LEAST_SIZE_RATIO = 1.5  #: Of the larger lump's diameter to the smaller one's.
ALIKE = 0.05  #: Frames that differ by less than this share of what the lump adds are called indistinguishable.
_STEP = 0.01  #: Step of the depths, in diameters, that are interpolated between those solved.


def centre_line(values: FloatArray) -> FloatArray:
    """Mean of the two middle ones of (..., n) taxels: the centre line of frames (m, rows, columns)."""
    half = values.shape[-1] // 2
    return np.asarray(values[..., half - 1 : half + 1].mean(axis=-1))


class CentredFrame(Record, eq=False):
    """The frame with the head's centre over a lump, as taxels see it."""

    d_mm: float
    depth_ratio: float
    share: FloatArray  #: (n,) array: Pressure over the frame's mean.
    added: FloatArray  #: (n,) array: `share` less that of the same layers without the lump.


class Lookalikes(Record, eq=False):
    """Two lumps of different size with the most alike frames."""

    small: CentredFrame
    large: CentredFrame

    @property
    def of_mean(self) -> float:
        """Root mean square difference as a share of the frames' mean."""
        return _rms(self.large.share - self.small.share)

    @property
    def difference(self) -> float:
        """The same over the root mean square of what the smaller lump adds."""
        return self.of_mean / _rms(self.small.added)


def centred_frame(d_mm: float, depth_ratio: float, *, settings: StudySettings, seat: float) -> CentredFrame:
    """The frame over a hard lump of one size and depth."""
    body = settings.body(d_mm, depth_ratio, seat=seat)
    reach = 0.5 * settings.cell_mm * len(settings.head.sensing_cells(settings.cell_mm))
    surface = plane.condense(body, reach_mm=reach, cell_mm=settings.cell_mm, fineness=settings.fineness)
    over, far = (one.as_taxels(HEAD_PITCH_MM) for one in (settings.over(surface), settings.far(body.layers)))
    share, plain = (np.asarray(one.at(0.0) / one.at(0.0).mean()) for one in (over, far))
    return CentredFrame(d_mm, depth_ratio, share, share - plain)


def find_lookalikes(
    settings: StudySettings,
    *,
    seat: float,
    diameters_mm: Sequence[float] = PAPER_DIAMETERS_MM,
    depth_ratios: Sequence[float] = DEPTH_RATIOS,
) -> Lookalikes | None:
    """The two visible hard lumps with the most alike frames among those whose diameters differ by a factor of
    `LEAST_SIZE_RATIO` or more; None where no two are visible.

    `diameters_mm` and `depth_ratios` must rise. Frames are interpolated in steps of 0.01 between the depths solved
    (cubic splines in h/d); the depth of the larger lump of the best pair is then refined with the model itself.
    """
    coarse = replace(settings, fineness=1)
    tried = np.round(np.arange(depth_ratios[0], depth_ratios[-1] + 1e-9, _STEP), 6)
    shares, added = {}, {}
    for d in diameters_mm:
        frames = [centred_frame(d, h, settings=coarse, seat=seat) for h in depth_ratios]
        shares[d] = CubicSpline(depth_ratios, np.stack([frame.share for frame in frames]))(tried)
        added[d] = CubicSpline(depth_ratios, np.stack([one.added for one in frames]))(tried)
    pairs = []  # the gap, then diameter and depth of either lump
    for d, e in itertools.combinations(sorted(diameters_mm), 2):
        if LEAST_SIZE_RATIO * d > e:
            continue
        gaps = np.sqrt(np.mean((shares[d][:, None] - shares[e]) ** 2, axis=2))
        gaps /= np.sqrt(np.mean(added[d] ** 2, axis=1))[:, None]
        gaps[(centre_line(added[d]) < LEAST_RISE)[:, None] | (centre_line(added[e]) < LEAST_RISE)] = np.inf
        i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
        if np.isfinite(gaps[i, j]):
            pairs.append((float(gaps[i, j]), d, float(tried[i]), e, float(tried[j])))
    if not pairs:
        return None
    _, small_mm, small_depth, d_mm, depth = min(pairs)
    small = centred_frame(small_mm, small_depth, settings=settings, seat=seat)

    def pair(depth_ratio: float) -> Lookalikes:
        return Lookalikes(small, centred_frame(d_mm, depth_ratio, settings=settings, seat=seat))

    ends = max(depth - 2 * _STEP, depth_ratios[0]), min(depth + 2 * _STEP, depth_ratios[-1])
    best = minimize_scalar(lambda h: pair(h).difference, bounds=ends, method="bounded", options={"xatol": 1e-3})
    return pair(float(best.x))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- The homogeneous-pressure condition of section 2.1: how evenly a head presses on tissue without layers or lump.
#
# In the paper's finite elements the pressure across the indentor lies within 7.5 % of the mean, for moduli of 15-25
# kPa under mean pressures of 5-14 kPa; the paper gives neither the radius of the head nor the thickness of the tissue.
# The model is linear, so that only the ratio of mean pressure to modulus matters.

RADII_MM = (13.0, 16.0, 20.0, 25.0, 30.0, 35.0, 45.0, 60.0, 70.0, 80.0, 100.0, 150.0, 300.0, np.inf)
SHOULDERS_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0)
# Contact cells: three a taxel. Six change the departure of a head that meets the limit by less than 0.001.
_CELL_MM = 0.5


class HomogeneousTissue(TissueOptions):
    """Tissue and pressures over which a head should press evenly."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("modulus_kpa", "pressure_kpa"):
            low, high = getattr(self, name)
            if not low <= high:
                way_out = "give two numbers above 0, the lower first"
                raise BadDataError(f"{name} is {low:g} to {high:g}", way_out=way_out)

    @property
    def moduli_kpa(self) -> FloatArray:
        """(3,) both ends and the middle."""
        return np.linspace(*self.modulus_kpa, 3)

    @property
    def pressures_kpa(self) -> FloatArray:
        """(3,) both ends and the middle."""
        return np.linspace(*self.pressure_kpa, 3)


class Uniformity(Record, eq=False):
    """How evenly one head presses."""

    head: HeadSection  #: Its section.
    s_mm: FloatArray  #: (n,) array: Taxel positions across the head.
    share: FloatArray  #: (3, 3, n) array: Pressure over the frame's mean, for each modulus and each mean pressure.

    @property
    def largest(self) -> FloatArray:
        """(3, 3) largest departure of a taxel from the mean of its frame, as a share of it."""
        return np.asarray(np.abs(self.share - 1.0).max(axis=-1))

    @property
    def rms(self) -> FloatArray:
        """(3, 3) root mean square departure."""
        return np.asarray(np.sqrt(np.mean((self.share - 1.0) ** 2, axis=-1)))

    @property
    def worst(self) -> float:
        """The largest departure over all moduli and pressures."""
        return float(self.largest.max())

    @property
    def worst_rms(self) -> float:
        """The largest root mean square departure over all moduli and pressures."""
        return float(self.rms.max())

    @property
    def face_mm(self) -> float:
        """Width of the rigid face, shoulders included."""
        return 2 * self.head.half_face_mm


def uniformity(head: HeadSection, tissue: HomogeneousTissue, *, cell_mm: float = _CELL_MM) -> Uniformity:
    """How evenly a head presses on homogeneous tissue."""
    # halving the thickness into two equal layers is the homogeneous body
    layers = Layers(0.5 * tissue.thickness_mm, tissue.thickness_mm, 1.0, 1.0, tissue.poisson)
    strain = tissue.pressures_kpa[None, :] / tissue.moduli_kpa[:, None]
    frames = plane.press_layers(layers, head=head, mean_kpa=strain.ravel(), cell_mm=cell_mm).as_taxels(HEAD_PITCH_MM)
    share = frames.pressure_kpa / frames.pressure_kpa.mean(axis=1, keepdims=True)
    return Uniformity(head, frames.s_mm, share.reshape(3, 3, -1))


def search_heads(
    tissue: HomogeneousTissue,
    *,
    kinds: Sequence[str] = HEADS,
    radii_mm: Sequence[float] = RADII_MM,
    shoulders_mm: Sequence[float] = SHOULDERS_MM,
) -> list[Uniformity]:
    """Uniformity of every head on a grid of shoulder positions (`presets.HEADS`) and radii of arc and shoulders;
    impossible sections are left out."""
    sections = [
        HeadSection(radius_mm=radius, shoulder_mm=shoulder, shoulders=kind)
        for kind in kinds
        for radius in radii_mm
        for shoulder in shoulders_mm
        if shoulder < (HeadSection().half_width_mm if kind == SHOULDERS_INSIDE else radius)
    ]
    return [uniformity(section, tissue) for section in sections]


def most_even(heads: Sequence[Uniformity]) -> Uniformity:
    """The head whose largest departure is smallest."""
    return min(heads, key=lambda head: head.worst)


def narrowest(heads: Sequence[Uniformity], *, limit: float, by_rms: bool = False) -> Uniformity | None:
    """The head with the narrowest face, and of those the most even, whose largest departure as a share of the mean is
    within `limit`; None without any.

    `by_rms` limits the root mean square departure instead: another reading of the paper's "variation".
    """
    departure = {id(head): head.worst_rms if by_rms else head.worst for head in heads}
    within = [head for head in heads if departure[id(head)] <= limit]
    return min(within, key=lambda head: (round(head.face_mm, 6), departure[id(head)]), default=None)
