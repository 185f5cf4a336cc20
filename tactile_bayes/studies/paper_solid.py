"""The forward study in three dimensions: frames over a ball, their maps, and the Gaussian of each map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from tactile_bayes.declarations import Record, as_dict, field, replace
from tactile_bayes.forward.axisymmetric import CondensedLump, condense_lump
from tactile_bayes.forward.mesh import LumpGeometry, MeshSize
from tactile_bayes.forward.plane import FINENESS, LineFrames, fit_height
from tactile_bayes.forward.scene import Head
from tactile_bayes.forward.simulate import RANK_TOLERANCE, SkinPerturbation, SolidHead, skin_perturbation, solid_head
from tactile_bayes.forward.tissue import Body, Layers
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.accumulate import divided
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import Bump, FitCells, window_cells
from tactile_bayes.posterior.white import LEAST_WIDTH_IN_CELLS, MOST_AXIS_RATIO, WIDEST_IN_RADII
from tactile_bayes.presets import FIT_RADIUS_MM, Background
from tactile_bayes.scans import CountArray, ElementCalibration, HeadGeometry, PressureFrames, Scan, TrackerPoses
from tactile_bayes.studies.paper import HARD_RATIO, CaseSettings, MapFit, centre_line

# --- Maps of a study's raster of frames, built and fitted like a patient's.

# Readings are stored as whole numbers, in counts per mean of the frame: 30 times the mean still fits.
_COUNTS: Final = 2048
_WINDOW: Final = (0.5, 2.0)  #: Pressure window of the map; every frame's mean is 1 here, so that none is left out.
# The pitch does not resolve a bump that is narrower than this share of it.
_LEAST_WIDTH_IN_PITCHES: Final = 0.8
_WIDTHS_ON_GRID: Final = 14  #: Widths along each axis of the grid whose best pair is refined.


def raster_map(frames: RasterFrames) -> TactileMap:
    """Build the map of a raster with cells of half a pitch, so that every reading lies in the middle of one.

    Poses are level and in the body's frame, readings are over the frame's mean. Where the raster has a plain frame, the
    frames are divided by the head's own response as by `map --flat-field`, which estimates it from the calm frames of a
    patient's scan; here it is known.
    """
    count, head = len(frames.x_mm), frames.head
    time, shape = np.arange(float(count)) / 100.0, (head.rows, head.columns)
    places = np.stack([frames.x_mm, frames.y_mm, frames.depth_mm], axis=-1)
    gains = np.full(shape, 1.0 / _COUNTS)
    scan = Scan(
        frames=PressureFrames(time, _readings(frames.pressure_kpa)),
        poses=TrackerPoses(time, places, np.tile([1.0, 0, 0, 0], (count, 1))),
        head=HeadGeometry(head.surface_mm(), head.pitch_mm, np.eye(4)),
        element_calibration=ElementCalibration(gains, np.zeros(shape), saturation_count=np.iinfo(np.uint16).max),
        landmarks=None,
        session={"source": "simulated"},
    )
    if frames.plain_kpa is not None:
        plain = _readings(frames.plain_kpa)
        scan = divided(scan, plain / plain.mean())
    return build_map(scan, cell_mm=head.pitch_mm / 2, pressure_window_kpa=_WINDOW, normalise="mean", as_stated=True)


def _readings(pressure_kpa: FloatArray) -> CountArray:
    """(..., rows, columns) frames over their means, as whole numbers."""
    share = pressure_kpa / pressure_kpa.mean(axis=(-2, -1), keepdims=True)
    counts: CountArray = np.clip(np.rint(share * _COUNTS), 0, np.iinfo(np.uint16).max - 1).astype(np.uint16)
    return counts


def fit_raster(tactile_map: TactileMap, settings: SolidSettings) -> MapFit:
    """Fit Eq 7 about the lump's axis with equal weights; the level is fitted or 1, by the settings.

    All readings of a cell come from its middle, so the Gaussian is not averaged over the cell, as it is for a patient's
    map, whose readings are spread over their cells. Both maps average over a taxel.

    The widths are searched for the lowest minimum between half a taxel and three quarters of the radius, with the
    amplitude, and a free level, eliminated, as in `paper.fit_line` (see `plane.fit_shape`).
    """
    radius_mm, free = settings.fit_radius_mm, settings.background == "free"
    cells = replace(window_cells(tactile_map, (0.0, 0.0), radius_mm=radius_mm), cell_mm=0.0)
    pitch = settings.head.pitch_mm
    ends = np.log([LEAST_WIDTH_IN_CELLS * pitch, WIDEST_IN_RADII * radius_mm])

    def misfit(log_widths: FloatArray) -> float:
        return _height(log_widths, cells, free=free)[1]

    line = np.linspace(ends[0], ends[1], _WIDTHS_ON_GRID)
    start: FloatArray = min((np.array([x, y], dtype=np.float64) for x in line for y in line), key=misfit)
    inwards = np.where(start > ends.mean(), -0.4, 0.4) * (line[1] - line[0])
    simplex = start + inwards * np.array([[0, 0], [1, 0], [0, 1]])
    best = minimize(
        misfit,
        start,
        method="Nelder-Mead",
        bounds=[(float(ends[0]), float(ends[1]))] * 2,
        options={"xatol": 1e-9, "fatol": np.inf, "maxiter": 400, "initial_simplex": simplex},
    )
    log_widths = np.asarray(best.x, dtype=np.float64)
    amplitude, sse = _height(log_widths, cells, free=free)
    narrow, wide = sorted(np.exp(log_widths))
    resolved = (
        narrow >= _LEAST_WIDTH_IN_PITCHES * pitch
        and log_widths.max() < ends[1] - 1e-6
        and wide <= MOST_AXIS_RATIO * narrow
    )
    sigma_x, sigma_y = np.exp(log_widths).tolist()
    return MapFit(amplitude, (sigma_x, sigma_y), float(np.sqrt(sse / len(cells))), bool(resolved))


def _height(log_widths: FloatArray, cells: FitCells, *, free: bool) -> tuple[float, float]:
    """Best amplitude of a bump of given widths on a level of 1 or a free one, and the residual sum of squares."""
    p, q = np.array([[0.5, 0.5], [0.5, -0.5]]) @ log_widths
    shape = Bump(background=1.0).unit_bump(np.array([[1.0, 0.0, 0.0, p, q]]), cells)[0]
    excess = cells.value - 1.0
    if free:
        # residuals of both after a level is fitted
        shape, excess = shape - shape.mean(), excess - excess.mean()
    return fit_height(shape, excess)


# --- The forward study in three dimensions: the frames over a ball, over sizes, depths, stiffnesses and seats.
#
# The head stands on a raster of positions about the lump. By symmetry a quarter of them is solved and the rest
# mirrored.

REACH_MM = 33.0
LINES_MM = (0.0, 6.0, 12.0)
_LEVEL = np.eye(3)


class SolidSettings(CaseSettings, kw_only=True):
    """Settings of a solid study: all that its table depends on besides its cases."""

    head: Head = field(default_factory=Head)  #: The array and the rim around it.
    reach_mm: float = REACH_MM
    lines_mm: tuple[float, ...] = LINES_MM
    """`reach_mm`, `lines_mm`: Across itself the head stands at steps of the taxels' pitch out to `reach_mm` on either
    side; along itself on lines at these distances on either side, which must be whole steps."""
    fit_radius_mm: float = FIT_RADIUS_MM  #: Eq 7 is fitted within this distance of the lump's axis.
    rank_tolerance: float = RANK_TOLERANCE  #: See `simulate.skin_perturbation`.
    mesh_reach_mm: float = MeshSize().reach_mm  #: Radius at which the mesh ends, on a rim that does not move.
    background: Background = "free"  #: ``"free"``: Eq 7's level is fitted; ``"fixed"``: it is 1.
    flat_field: bool = True  #: True when each taxel is divided by what it reads of the same body without the lump.

    def as_dict(self) -> dict[str, object]:
        """Plain data for a store's header."""
        return {"model": "solid", **as_dict(self)}

    def recipe(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("background", "fit_radius_mm", "flat_field")}

    def maps(self, body: Body) -> Callable[[float], TactileMap]:
        head, condensed = self.on(body), self.condensed(body)
        return lambda ratio: raster_map(raster_frames(head, [self.placed(condensed, ratio)], self))

    def fitted(self, tactile_map: TactileMap) -> MapFit:
        return fit_raster(tactile_map, self)

    def geometry(self, body: Body) -> LumpGeometry:
        """The ball in the body."""
        return LumpGeometry(body.radius_mm, body.radius_mm, body.centre_mm, body.layers)

    def condensed(self, body: Body) -> CondensedLump:
        """The body around the ball, condensed."""
        return condense_lump(self.geometry(body), size=self.mesh_size)

    @property
    def mesh_size(self) -> MeshSize:
        """Mesh size for the fineness and the reach; 2 is the default, and doubling it halves every element."""
        default, share = MeshSize(), self.fineness / FINENESS
        return MeshSize(
            arc=round(default.arc * share),
            rings=round(default.rings * share),
            core=int(np.ceil(default.core * share)),
            grade=float(default.grade ** (1.0 / share)),
            reach_mm=self.mesh_reach_mm,
        )

    def on(self, body: Body) -> SolidHead:
        """The head on the body without a lump."""
        return solid_head(self.head, body.layers)

    def far(self, layers: Layers) -> LineFrames:
        """The frame far from any lump, across the middle of the head."""
        return self._middle(solid_head(self.head, layers), [])

    def over_lump(self, body: Body) -> LineFrames:
        """The frame with the head's centre over a hard lump, across the middle of the head."""
        return self._middle(self.on(body), [self.placed(self.condensed(body), HARD_RATIO)])

    def _middle(self, head: SolidHead, lumps: Sequence[SkinPerturbation]) -> LineFrames:
        frame, _ = head.frame(lumps, _LEVEL, (0.0, 0.0), mean_kpa=self.mean_kpa)
        return LineFrames(np.zeros(1), self.head.surface_mm()[:, 0, 0], centre_line(frame[None]))

    def placed(self, condensed: CondensedLump, stiffness_ratio: float) -> SkinPerturbation:
        """The lump under the middle of the raster."""
        return skin_perturbation(
            condensed, stiffness_ratio * self.fat_kpa, square_mm=self.head.pitch_mm, tolerance=self.rank_tolerance
        )


class RasterFrames(Record, eq=False):
    """Frames of a level head on a raster of positions."""

    x_mm: FloatArray
    y_mm: FloatArray
    depth_mm: FloatArray
    """`x_mm`, `y_mm`, `depth_mm` (n,) arrays: Position of the apex of the head's face from the lump's axis, and its
    depth below the undisturbed skin."""
    pressure_kpa: FloatArray  #: (n, rows, columns) array.
    head: Head
    plain_kpa: FloatArray | None = None
    """(rows, columns) array: The head's frame over the same body without the lump; None where the map is not divided by
    it."""


def raster_frames(head: SolidHead, lumps: Sequence[SkinPerturbation], settings: SolidSettings) -> RasterFrames:
    """Frames of the raster over lumps at its middle, or over the plain body.

    The lump is symmetric about both axes of the level head, so the frame at (-x, y) is the one at (x, y) with its rows
    reversed, and that at (x, -y) with its columns reversed. The layers are the same everywhere, so the head has one
    frame without the lump.
    """
    pitch = settings.head.pitch_mm
    count = int(np.floor(settings.reach_mm / pitch + 1e-9))
    places, depths, frames = [], [], []
    touching: NDArray[np.bool_] | None = None
    for line in settings.lines_mm:
        y = pitch * round(line / pitch)
        for x in pitch * np.arange(count + 1.0):
            pressure, contact = head.frame(lumps, _LEVEL, (x, y), mean_kpa=settings.mean_kpa, touching=touching)
            touching = contact.touching
            for side in (1, -1) if x > 0 else (1,):
                for end in (1, -1) if y > 0 else (1,):
                    places.append((side * x, end * y))
                    depths.append(contact.depth_mm)
                    frames.append(pressure[::side, ::end])
    plain = None
    if settings.flat_field:
        plain = head.frame([], _LEVEL, (0.0, 0.0), mean_kpa=settings.mean_kpa)[0]
    place = np.array(places)
    return RasterFrames(place[:, 0], place[:, 1], np.array(depths), np.stack(frames), settings.head, plain)
