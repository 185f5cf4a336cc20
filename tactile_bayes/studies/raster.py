"""Maps of a study's raster of frames, built and fitted like a patient's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from tactile_bayes.forward.solid.study import RasterFit, RasterFrames, SolidSettings
    from tactile_bayes.geometry import FloatArray
    from tactile_bayes.mapping.tactile_map import TactileMap
    from tactile_bayes.posterior.lump.cells import FitCells
    from tactile_bayes.scan import CountArray, Scan

# Readings travel as whole numbers: this many a unit of the frame's mean, so that 30 times the mean still fits.
_COUNTS: Final = 2048
# Where the rest of the program would leave out frames by their mean, which here is 1.
_WINDOW: Final = (0.5, 2.0)
# A narrower bump than this share of the taxels' pitch is one that the pitch does not resolve.
_LEAST_WIDTH_IN_PITCHES: Final = 0.8
# Widths that are tried before the best pair of them is refined, along each axis.
_TRIED: Final = 14


def raster_scan(frames: RasterFrames) -> Scan:
    """Convert a raster to a scan: level poses in the body's frame, readings over the frame's mean."""
    import numpy as np

    from tactile_bayes.scan import ElementCalibration, HeadGeometry, PressureFrames, Scan, TrackerPoses

    head, count = frames.head, len(frames.x_mm)
    time = np.arange(float(count)) / 100.0
    readings = _readings(frames.pressure_kpa)
    shape = (head.rows, head.columns)
    return Scan(
        frames=PressureFrames(time, readings),
        poses=TrackerPoses(
            time, np.stack([frames.x_mm, frames.y_mm, frames.depth_mm], axis=-1), np.tile([1.0, 0, 0, 0], (count, 1))
        ),
        head=HeadGeometry(head.surface_mm(), head.pitch_mm, np.eye(4)),
        element_calibration=ElementCalibration(
            np.full(shape, 1.0 / _COUNTS), np.zeros(shape), saturation_count=np.iinfo(np.uint16).max
        ),
        landmarks=None,
        session={"source": "simulated"},
    )


def raster_map(frames: RasterFrames) -> TactileMap:
    """Build the map of a raster with cells of half a pitch, so that every reading lies in the middle of one.

    Notes
    -----
    Where the raster has a plain frame, the head's own response is taken off as `map --flat-field` takes off a
    patient's. There it is found from the scan's own calm frames; here it is known.
    """
    from tactile_bayes.mapping.build import build_map
    from tactile_bayes.mapping.flat_field import FlatField

    scan = raster_scan(frames)
    if frames.plain_kpa is not None:
        plain = _readings(frames.plain_kpa)
        scan = FlatField(plain / plain.mean(), frames=1).applied(scan)
    return build_map(scan, cell_mm=frames.head.pitch_mm / 2, pressure_window_kpa=_WINDOW, normalise="mean")


def _readings(pressure_kpa: FloatArray) -> CountArray:
    """(..., rows, columns) frames over their means, as whole numbers."""
    import numpy as np

    share = pressure_kpa / pressure_kpa.mean(axis=(-2, -1), keepdims=True)
    counts: CountArray = np.clip(np.rint(share * _COUNTS), 0, np.iinfo(np.uint16).max - 1).astype(np.uint16)
    return counts


def fit_raster(frames: RasterFrames, settings: SolidSettings) -> RasterFit:
    """Fit Eq 7 about the lump's axis with equal weights; the level is fitted or 1, by the settings.

    Notes
    -----
    All readings of a cell come from its middle, so the Gaussian is not averaged over it. A patient's readings are
    spread over their cells and the Gaussian is averaged there; what remains in both is the average over a taxel.

    The lowest minimum between widths of half a taxel and three quarters of the radius is sought with the amplitude, and
    a free level, eliminated, as in `study.fit_line`: steps of Gauss and Newton do not settle on a faint bump in its
    trough.
    """
    from dataclasses import replace

    import numpy as np

    from tactile_bayes.forward.solid.study import RasterFit
    from tactile_bayes.posterior.lump.cells import window_cells
    from tactile_bayes.posterior.white.fit import LEAST_WIDTH_IN_CELLS, MOST_AXIS_RATIO, WIDEST_IN_RADII

    radius_mm, free = settings.fit_radius_mm, settings.background == "free"
    cells = replace(window_cells(raster_map(frames), (0.0, 0.0), radius_mm=radius_mm), cell_mm=0.0)
    pitch = frames.head.pitch_mm
    ends = np.log([LEAST_WIDTH_IN_CELLS * pitch, WIDEST_IN_RADII * radius_mm])
    log_widths = _lowest(cells, ends, free=free)
    amplitude, sse = _height(log_widths, cells, free=free)
    narrow, wide = sorted(np.exp(log_widths))
    resolved = (
        narrow >= _LEAST_WIDTH_IN_PITCHES * pitch
        and log_widths.max() < ends[1] - 1e-6
        and wide <= MOST_AXIS_RATIO * narrow
    )
    sigma_x, sigma_y = (float(width) for width in np.exp(log_widths))
    return RasterFit(amplitude, sigma_x, sigma_y, float(np.sqrt(sse / len(cells))), bool(resolved))


def _height(log_widths: FloatArray, cells: FitCells, *, free: bool) -> tuple[float, float]:
    """Best amplitude of a bump of given widths on a level of 1 or a free one, and the remaining sum of squares."""
    import numpy as np

    from tactile_bayes.posterior.lump.bump import Bump

    p, q = np.array([[0.5, 0.5], [0.5, -0.5]]) @ log_widths
    shape = Bump(background=1.0).unit_bump(np.array([[1.0, 0.0, 0.0, p, q]]), cells)[0]
    excess = cells.value - 1.0
    if free:
        # what is left of both once a level is taken off
        shape, excess = shape - shape.mean(), excess - excess.mean()
    height = float(shape @ excess / (shape @ shape))
    return height, float(np.sum((excess - height * shape) ** 2))


def _lowest(cells: FitCells, ends: FloatArray, *, free: bool) -> FloatArray:
    """(2,) log widths of the lowest minimum between the ends."""
    import numpy as np
    from scipy.optimize import minimize

    def left(log_widths: FloatArray) -> float:
        return _height(log_widths, cells, free=free)[1]

    line = np.linspace(ends[0], ends[1], _TRIED)
    tried = [np.array([x, y], dtype=np.float64) for x in line for y in line]
    start: FloatArray = min(tried, key=left)
    inwards = np.where(start > ends.mean(), -0.4, 0.4) * (line[1] - line[0])
    found = minimize(
        left,
        start,
        method="Nelder-Mead",
        bounds=[(float(ends[0]), float(ends[1]))] * 2,
        options={
            "xatol": 1e-9,
            "fatol": np.inf,
            "maxiter": 400,
            "initial_simplex": start + inwards * np.array([[0, 0], [1, 0], [0, 1]]),
        },
    )
    return np.asarray(found.x, dtype=np.float64)
