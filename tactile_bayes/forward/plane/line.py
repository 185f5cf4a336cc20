r"""Frames of a head that slides over the lump in two dimensions, and the map they average to.

A map is the mean of all pressures measured at a place. Here a frame is the pressure on the cells under the head, the
head stands at equal steps, and a cell of the map is as wide as a step: it takes every reading whose cell lies in it
(whole cells always do). Far from the lump a map cell so collects the head's profile at equal distances over the whole
width, each once, and its mean is the mean of a frame: 1 after normalising, without a correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import Layers
from tactile_bayes.forward.contact import Contact, Head, solve_contact
from tactile_bayes.forward.plane.condense import CELL_MM, SurfaceCompliance
from tactile_bayes.forward.plane.layers import surface_compliance
from tactile_bayes.geometry import FloatArray

MEAN_KPA = 9.5
POSITIONS_MM = (-60.0, 60.0, 0.5)
_NOMINAL_HEAD = Head()


@dataclass(frozen=True, slots=True, eq=False)
class LineFrames:
    """Pressure across the head at each of its positions.

    Parameters
    ----------
    x_c_mm : (m,) array
        Centre of the head, from the lump's axis.
    s_mm : (n,) array
        Centres of the cells from the head's centre.
    pressure_kpa : (m, n) array
    """

    x_c_mm: FloatArray
    s_mm: FloatArray
    pressure_kpa: FloatArray

    def __post_init__(self) -> None:
        shape = (len(self.x_c_mm), len(self.s_mm))
        if self.pressure_kpa.shape != shape:
            raise BadDataError(
                f"pressure_kpa has shape {self.pressure_kpa.shape}", way_out=f"it must be {shape} (positions, cells)"
            )

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
        if group < 1 or abs(group * self.cell_mm - pitch_mm) > 1e-9 or len(self.s_mm) % group:
            raise BadDataError(
                f"pitch_mm is {pitch_mm:g}",
                way_out=f"it must hold whole cells of {self.cell_mm:g} mm and fill the head",
            )
        means = self.pressure_kpa.reshape(len(self.x_c_mm), -1, group).mean(axis=2)
        return LineFrames(self.x_c_mm, self.s_mm.reshape(-1, group).mean(axis=1), means)


@dataclass(frozen=True, slots=True, eq=False)
class TactileLine:
    """A one-dimensional tactile map: the counterpart of `TactileMap` for a line.

    Parameters
    ----------
    x_mm : (k,) array
        Centres of the map's cells.
    mean : (k,) array
        Mean of the readings in a cell; NaN without any.
    count : (k,) int array
    cell_mm
        Width of the map's cells.
    """

    x_mm: FloatArray
    mean: FloatArray
    count: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    cell_mm: float


def head_positions(positions_mm: tuple[float, float, float] = POSITIONS_MM) -> FloatArray:
    """Equal steps of the head from first to last, both included."""
    first, last, step = positions_mm
    return np.asarray(first + step * np.arange(round((last - first) / step) + 1), dtype=np.float64)


def press(
    surface: SurfaceCompliance,
    stiffness_ratio: float | None,
    x_c_mm: FloatArray,
    *,
    head: Head = _NOMINAL_HEAD,
    mean_kpa: float | FloatArray = MEAN_KPA,
) -> LineFrames:
    """Frames of a head pressed with given force at positions `x_c_mm`.

    Parameters
    ----------
    stiffness_ratio
        E2/E1 of the lump; None for the body without a lump.
    mean_kpa
        Mean pressure over the sensing width: one for all, or (m,) of them.

    Returns
    -------
    LineFrames
        Of the sensing cells; shoulders outside them press and are not in the frames.

    Raises
    ------
    BadDataError
        When the head would leave the surface.
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
    usual = _layers_contact(surface.body.layers, head=head, mean_kpa=np.median(level, keepdims=True), cell_mm=cell)
    touching = usual.pressure_kpa[0] > 0
    count = int(senses.sum())
    pressure = np.empty((len(first), count))
    for chunk in np.array_split(np.arange(len(first)), int(np.ceil(len(first) / 64))):
        windows = _windows(matrix, first[chunk], len(profile))
        pressure[chunk] = solve_contact(
            windows, profile, total_kpa=level[chunk] * count, touching=touching, counted=senses
        ).pressure_kpa[:, senses]
    return LineFrames(np.asarray(x_c_mm, dtype=np.float64), _cell_centres(count, cell), pressure)


def press_layers(
    layers: Layers, *, head: Head = _NOMINAL_HEAD, mean_kpa: float | FloatArray = MEAN_KPA, cell_mm: float = CELL_MM
) -> LineFrames:
    """Frames of a body without a lump, P1, one per mean pressure; they do not depend on the head's position."""
    level = np.atleast_1d(np.asarray(mean_kpa, dtype=np.float64))
    senses = head.sensing_cells(cell_mm)
    pressure = _layers_contact(layers, head=head, mean_kpa=level, cell_mm=cell_mm).pressure_kpa[:, senses]
    return LineFrames(np.zeros(len(level)), _cell_centres(int(senses.sum()), cell_mm), pressure)


def _layers_contact(layers: Layers, *, head: Head, mean_kpa: FloatArray, cell_mm: float) -> Contact:
    """The whole face on a body without a lump, for (m,) mean pressures over the sensing width."""
    profile, senses = head.cell_profile_mm(cell_mm), head.sensing_cells(cell_mm)
    index = np.arange(len(profile))
    row = surface_compliance(np.asarray(cell_mm * index), cell_mm=cell_mm, layers=layers)
    matrix = row[np.abs(index[:, None] - index[None, :])]
    windows = np.broadcast_to(matrix, (len(mean_kpa), *matrix.shape))
    return solve_contact(windows, profile, total_kpa=mean_kpa * senses.sum(), counted=senses)


def _cell_centres(count: int, cell_mm: float) -> FloatArray:
    """(count,) centres of the head's cells from its own centre."""
    return np.asarray(cell_mm * (np.arange(count) - 0.5 * (count - 1)), dtype=np.float64)


def _windows(matrix: FloatArray, first: FloatArray, n: int) -> FloatArray:
    """(m, n, n) diagonal blocks that begin at `first`; between two cells, the weighted mean of both blocks."""
    blocks = np.lib.stride_tricks.sliding_window_view(matrix, (n, n))
    low = np.clip(np.floor(first + 1e-9).astype(np.intp), 0, len(matrix) - n)
    share = first - low
    windows = blocks[low, low].copy()
    between = np.flatnonzero(np.abs(share) > 1e-9)
    if len(between):
        part, above = share[between, None, None], low[between] + 1
        windows[between] += part * (blocks[above, above] - windows[between])
    return windows


def slide(
    surface: SurfaceCompliance,
    stiffness_ratio: float | None,
    *,
    head: Head = _NOMINAL_HEAD,
    mean_kpa: float = MEAN_KPA,
    positions_mm: tuple[float, float, float] = POSITIONS_MM,
) -> LineFrames:
    """Simulate frames of a head that slides across the lump; mirrored positions are solved once."""
    x_c = head_positions(positions_mm)
    if not np.allclose(x_c, -x_c[::-1], rtol=0, atol=1e-9):
        return press(surface, stiffness_ratio, x_c, head=head, mean_kpa=mean_kpa)
    half = press(surface, stiffness_ratio, x_c[len(x_c) // 2 :], head=head, mean_kpa=mean_kpa)
    mirrored = half.pressure_kpa[::-1, ::-1][: len(x_c) // 2]
    return LineFrames(x_c, half.s_mm, np.concatenate([mirrored, half.pressure_kpa]))


def build_line(frames: LineFrames, *, normalise: str = "mean") -> TactileLine:
    """Average frames, each divided by its mean, in cells along the line.

    Parameters
    ----------
    frames
        At equal steps; the map's cells are as wide as a step, with edges at multiples of it.
    normalise
        ``"mean"`` divides each frame by its mean, ``"none"`` keeps kPa.
    """
    if normalise not in ("mean", "none"):
        raise BadDataError(f"normalise is {normalise!r}", way_out="give mean or none")
    step = float(frames.x_c_mm[1] - frames.x_c_mm[0])
    values = frames.pressure_kpa
    if normalise == "mean":
        values = values / values.mean(axis=1, keepdims=True)
    place = (frames.x_c_mm[:, None] + frames.s_mm[None, :]) / step
    number = np.floor(place + 1e-9).astype(np.int64)
    low = int(number.min())
    count = np.bincount((number - low).reshape(-1))
    total = np.bincount((number - low).reshape(-1), weights=values.reshape(-1))
    with np.errstate(invalid="ignore"):
        mean = total / np.where(count > 0, count, np.nan)
    x: FloatArray = step * (low + np.arange(float(len(count))) + 0.5)
    return TactileLine(x, mean, count.astype(np.int64), step)
