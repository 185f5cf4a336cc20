"""The map itself: its cells, its recipe, what it assumes, advice on it, and its orientation on the screen."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Meta, Record, field, set_fields
from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding, capitalised, counted, finding
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.mapping.select import LEAST_FRAMES
from tactile_bayes.presets import Normalise
from tactile_bayes.scans import HeadShape

# --- Binomial smoothing of sums in cells.


def smooth(values: NDArray[np.generic], *, passes: int = 4) -> FloatArray:
    """Binomial smoothing along both axes; four passes have an SD of 1.4 cells."""
    smooth = np.asarray(values, dtype=np.float64)
    for _ in ("y", "x"):
        for _ in range(passes):
            padded = np.pad(smooth, ((1, 1), (0, 0)))
            smooth = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
        smooth = smooth.T
    return smooth


# --- The tactile map, with the recipe by which it was built.

FEW_READINGS = 10  #: Number of readings below which a cell is flagged: its mean is noisy, its variance even more so.


class MapRecipe(Record):
    """Settings by which a map was built; a size calibration fits only maps of its own recipe."""

    source: str  #: ``"scan"`` or ``"grid"`` (a map imported as it is).
    normalise: Normalise
    cell_mm: Annotated[float, Meta(gt=0)]  #: Side of the square cells.
    pressure_window_kpa: tuple[float, float] | None = None  #: The gate on the frame's mean; None for an imported grid.
    latency_ms: float = 0.0  #: Delay of a pose's stamp against the frames.
    flat_field: bool = False  #: True where readings were divided by the head's own response.
    registered: bool = False  #: True where the strokes were shifted onto each other.
    units: str = ""
    """Units of an imported grid's values, as the user named them; empty where unknown. A scan's are kPa."""

    @property
    def value_unit(self) -> str:
        """Unit of the map's values: ``"1"`` where they were divided by a level, empty where it is unknown."""
        if self.normalise != "none":
            return "1"
        return "kPa" if self.source == "scan" else self.units

    @property
    def value_words(self) -> str:
        """Label of a colour bar for the map's values."""
        if self.normalise == "none":
            name = "mean pressure" if self.source == "scan" else "value"
            return f"{name} ({self.value_unit or 'unit unknown'})"
        name = "pressure" if self.source == "scan" else "value"
        return f"{name} / {'mean of its frame' if self.normalise == 'mean' else 'level beside a lump'}"

    @property
    def flat_field_known(self) -> bool | None:
        """`flat_field` of a scan's map; None for an imported grid, where it is unknown."""
        return self.flat_field if self.source == "scan" else None


class TactileMap(Record, eq=False):
    """Mean normalised pressure on the best-fit plane."""

    mean: FloatArray
    variance: FloatArray
    """`mean`, `variance` (ny, nx) arrays: Mean and within-cell variance of the readings; NaN where `count` is 0.
    Without unit after normalising, kPa with ``normalise="none"``."""
    count: np.ndarray[tuple[int, ...], np.dtype[np.int64]]  #: (ny, nx) int64 array: Readings per cell.
    x_mm: FloatArray
    y_mm: FloatArray
    """`x_mm`, `y_mm` (nx,), (ny,) arrays: Cell centres in `plane`; x runs across the head, y along it."""
    recipe: MapRecipe  #: How the map was built.
    plane_from_base: FloatArray | None = None  #: (4, 4) array or None: None for an imported grid.
    patient_from_plane: FloatArray | None = None  #: (4, 4) array or None: None without landmarks.
    background: float | None = 1.0
    """Level far from the lump that normalising defines (1 in the paper's Eqs 5 and 7); None where it is not known."""
    frame_count: int = 0  #: Frames in the map. Cells share frames: there are fewer independent errors than readings.
    quality: Mapping[str, float] = field(default_factory=dict)
    """Counts and figures for the report (frames dropped low/high, tilt, rms...)."""
    masked_taxels: tuple[str, ...] = ()  #: Taxels that were left out, one line each: ``"row 3 column 7 dead"``.
    head: HeadShape | None = None  #: Shape of the head that made the scan; None for an imported grid.
    nipple_mm: FloatArray | None = None  #: (3,) array or None: The nipple in `plane`; None where it was not touched.
    findings: tuple[Finding, ...] = ()  #: Findings against the map's sizes.

    def __post_init__(self) -> None:
        shape = (len(self.y_mm), len(self.x_mm))
        for name in ("mean", "variance", "count"):
            if (actual := getattr(self, name).shape) != shape:
                raise BadDataError(f"{name} has shape {actual}", way_out=f"it must be {shape} (ny, nx)")
        if self.count.size and self.count.min() < 0:
            raise BadDataError(f"count holds {self.count.min()}", way_out="counts must not be negative")
        if not self.recipe.cell_mm > 0:
            raise BadDataError(f"cell_mm is {self.recipe.cell_mm}", way_out="it must be positive, in mm")
        for name in ("mean", "variance", "count", "x_mm", "y_mm"):
            view = getattr(self, name).view()
            view.flags.writeable = False
            set_fields(self, **{name: view})
        if (np.isinf(self.mean) & (self.count > 0)).any():
            raise BadDataError("mean holds infinite values", way_out="mark cells without data by count 0")

    @property
    def fingerprint(self) -> int:
        """First 64 bits of a hash of the cells and their values alone, to seed random numbers: the same in any file."""
        digest = hashlib.sha256(np.array(self.mean.shape, dtype="<i8").tobytes())
        covered = self.covered
        for values in (self.mean, self.variance, self.count):
            # NaN has many bit patterns: cells without data count as one value
            defined = np.where(covered & np.isfinite(values), values, 0.0)
            digest.update(np.ascontiguousarray(defined, dtype="<f8").tobytes())
        for axis in (self.x_mm, self.y_mm):
            digest.update(np.ascontiguousarray(axis, dtype="<f8").tobytes())
        return int.from_bytes(digest.digest()[:8], "big")

    @property
    def covered(self) -> BoolArray:
        """(ny, nx) True where the map has data."""
        return np.asarray((self.count > 0) & np.isfinite(self.mean))

    @property
    def counts_known(self) -> bool:
        """True if `count` is the number of readings per cell; an imported grid without counts has 1 everywhere."""
        return self.recipe.source == "scan" or bool((self.count > 1).any())

    @property
    def few(self) -> BoolArray:
        """(ny, nx) True for cells with data from fewer than `FEW_READINGS` readings; none where counts are unknown."""
        return np.asarray((self.count > 0) & (self.count < FEW_READINGS) & self.counts_known)


# --- Notice for maps with many more cells than a fit needs.

MANY_CELLS: Final = 20_000  #: In a window: 0.25 mm in the default one, up to five times the time of 1 mm (record 0074).


def many_cells(tactile_map: TactileMap, radius_mm: float) -> str | None:
    """Notice on the cost of a fit window of `MANY_CELLS` or more, and on cells that are fine enough; None for fewer.

    Counts the cells of a covered disc of `radius_mm`, or all of the map's where these are fewer.
    """
    cell = tactile_map.recipe.cell_mm
    cells = min(int(tactile_map.covered.sum()), int(math.pi * radius_mm**2 / cell**2))
    if cells < MANY_CELLS:
        return None
    advice = advise_cell(tactile_map)
    enough = "cells of half a bump's sigma measure it as well"
    if advice is not None and advice.coarsest_mm > cell:
        enough = f"cells of up to {math.floor(10 * advice.coarsest_mm) / 10:g} mm measure the highest bump as well"
    return (
        f"about {round(cells, -2):,} cells of {cell:g} mm are fitted, which takes a while (measured: 126,000 cells "
        f"20 s of CPU, 1,260 cells 1.4 s); {enough}: give `map` or `import` a larger --cell-mm"
    )


# --- Findings against the assumptions of a size (even layers, flat skin, a lump that stays where it is).
#
# The limits come from simulated bodies that break one of them (record 0103): none is passed by bodies that break none,
# and a caution stands where intervals of the size cover too seldom.

MOST_PROFILE_CHANGE = 0.01
"""Change of the second order across the head, over 30 mm: fat that deepens by 1 mm in 20 changes it by 0.01 to 0.06."""
BROKEN_PROFILE_CHANGE = 0.07
"""From here on sizes of simulated bodies lay outside their intervals: 1 mm in 5, or a step of 6 mm in thin fat."""
MOST_SKEW = 0.01
"""First order of the head profile, to one side along strokes: a friction coefficient of 0.1 gives 0.011 to 0.035."""
MOST_CURVATURE_PER_M = 4.0
"""Curvature of the head's path, a radius of 250 mm: rocking by 4 deg imitates up to 1.5 per m."""
MOST_LAG_MM = 1.2  #: A latency of 12 ms left in the poses makes up to 0.75 mm at a hand's 60 mm/s.
LEAST_STROKES = 4
"""As in the exams that sizes were learned from: 3 strokes, 8 mm apart, made sizes 6 to 9 % larger (record 0123)."""
MOST_USED = 0.7  #: Share of the frames below which strokes may be missing for the frames that are left out.
LEAST_COVERAGE = 0.5  #: A strip of the plane narrower than the head itself shows no lump's flanks.
MOST_TILT_DEG = 10.0
MOST_YAW_DEG = 15.0
_ERRORS = 2.5  #: Standard errors by which a figure must exceed 0, besides its limit.


def broken_assumptions(quality: Mapping[str, float], *, strokes_lengthwise: int = 0) -> Iterator[Finding]:
    """Findings from a map's `quality` figures against the assumptions of a size; missing figures give none.

    `strokes_lengthwise`: number of strokes along the head, counted where there are few across it.
    """
    enough = quality.get("frames_used", LEAST_FRAMES) >= LEAST_FRAMES  # of a few, a lag is noise
    if enough and (lag := _beyond(quality, "stroke_lag_mm", "stroke_lag_sd_mm", MOST_LAG_MM)):
        cause = "each dragged it along" if lag > 0 else "the tracker's positions came late"
        text = (
            f"strokes in opposite directions see the lump some {2 * abs(lag):.0f} mm apart, as if {cause}: the size "
            "may be off by more than its interval"
        )
        kind, option, again = "late_poses", "--latency-ms auto", "with the tracker's delay estimated"
        if lag > 0:
            kind, option, again = "lump_dragged", "--register-strokes", "with its strokes aligned to each other"
        yield finding(kind, text, f"map again with {option}", f"have the scan mapped again {again}")
    if change := _beyond(quality, "profile_change", "profile_change_sd", MOST_PROFILE_CHANGE):
        broken = change > BROKEN_PROFILE_CHANGE
        end = "the size may be off by more than its interval" if broken else "the size is for even fat"
        text = (
            f"the head presses differently in one part of the map than in another (by {change:.3f} in 30 mm, as the "
            "pressure falls off from the head's middle): the fat is of uneven depth, "
            f"or a rib or another lump lies near; {end}"
        )
        yield finding("uneven_fat" if broken else "slightly_uneven_fat", text)
    curvature = quality.get("skin_curvature_per_m", 0.0)
    if abs(curvature) > MOST_CURVATURE_PER_M:
        text = (
            f"the skin is {'curved outwards' if curvature > 0 else 'hollow'} here (radius "
            f"{1000 / abs(curvature):.0f} mm), and sizes are for flat skin (on radii of 150 and 75 mm simulated ones "
            "moved by 6 and 14 %)"
        )
        yield finding("curved_skin", text)
    strokes = quality.get("stroke_count", LEAST_STROKES)
    if strokes < LEAST_STROKES:
        few_used = quality.get("frames_used", 0.0) < MOST_USED * quality.get("frames_total", 0.0)
        whose = f"the {quality['frames_used']:.0f} frames used make" if few_used else "the scan has"
        text = (
            f"{whose} {counted(int(strokes), 'stroke')} only, and sizes were learned from 4 to 7 "
            "(simulated ones from 3 came out 6 to 9 % large)"
        )
        remedy = f"scan with {LEAST_STROKES} strokes or more, side by side"
        if strokes_lengthwise > strokes:
            text = f"the {strokes_lengthwise} strokes run along the head, and sizes were learned from strokes across it"
            remedy = "scan with the head turned by 90 degrees"
        yield finding("few_strokes", text, remedy, remedy)


MIDDLE_MM: Final = 20.0
"""So far from the xiphoid a place is on that side of the body, whatever is wrong with the landmarks' direction."""


def side_findings(
    side: str, patient_mm: Sequence[float] | None, what: str = "the lump", *, in_table: bool = False
) -> tuple[Finding, ...]:
    """Caution where the landmarks put the lump, or `what`, on the other side of the body than the scans say.

    `patient_mm`: from the xiphoid to the patient's right and up; None without landmarks or a lump. `in_table` is true
    if the table of exams says the side.
    """
    if side not in ("left", "right") or patient_mm is None or abs(patient_mm[0]) < MIDDLE_MM:
        return ()
    other = "right" if patient_mm[0] > 0 else "left"
    if other == side:
        return ()
    place = f"the landmarks put {what} {abs(patient_mm[0]):.0f} mm to the patient's {other} of the xiphoid"
    text = f"the {'table' if in_table else 'scan'} says {side} breast, and {place}: side or landmarks are wrong"
    check = "check which breast it was, and that sternal notch and xiphoid are not exchanged"
    by_import = "`import SCAN.mcap -o NEW.mcap` corrects them by --session and --landmarks"
    correct = "correct the row" if in_table else by_import
    return (finding("side", text, f"{check}; {correct}", check),)


def handling_findings(quality: Mapping[str, float]) -> Iterator[Finding]:
    """Findings from a map's `quality` figures on how the head was held and the array read."""
    if quality.get("saturated_readings"):
        number = f"{quality['saturated_readings']:.0f} readings"
        text = f"{number} were pressed beyond the array's range and left out: the map is too low there"
        yield finding("saturated_readings", text, "press less hard", "press less hard")
    if quality.get("clipped_values"):
        yield finding("clipped_values", f"{quality['clipped_values']:.0f} values beyond the map's range were clipped")
    if quality.get("gain_unsettled"):
        text = "how hard each frame was pressed could not be evened out: too few strokes overlap"
        remedy = "the frames' gains had not settled: use --normalise mean, or scan with overlapping strokes"
        yield finding("unsettled_gains", text, remedy, "scan with overlapping strokes")
    if quality.get("coverage", 1.0) < LEAST_COVERAGE:
        text = f"only {100 * quality['coverage']:.0f} % of the map's rectangle is covered"
        add = "add strokes side by side"
        yield finding("low_coverage", text, f"{add}, or use larger cells", add)
    if quality.get("tilt_deg", 0.0) > MOST_TILT_DEG:
        text = f"the head's face was tilted by {quality['tilt_deg']:.0f} degrees against its motion"
        check = "check the tracker's lever arm and quaternion order"
        yield finding("tilted_head", text, check, "hold it flat; if it was, have the tracker's mounting checked")
    if quality.get("yaw_sd_deg", 0.0) > MOST_YAW_DEG:
        turned = f"the head was turned by {quality['yaw_sd_deg']:.0f} degrees (SD)"
        text = f"{turned}: the lump's length and breadth are mixed"
        remedy = "keep the head square to its strokes"
        yield finding("turned_head", text, remedy, remedy)


def skewed(quality: Mapping[str, float]) -> str:
    """Sentence on skin that the head drags along, or none; it moves no size and is a matter of technique."""
    skew = _beyond(quality, "stroke_skew", "stroke_skew_sd", MOST_SKEW)
    if skew is None:
        return ""
    return f"pressure is skewed along the strokes (by {abs(skew):.3f}): the skin is dragged along, use more lubricant"


def _beyond(quality: Mapping[str, float], name: str, sd_name: str, limit: float) -> float | None:
    """The figure if it exceeds its limit and `_ERRORS` standard errors; else None."""
    value, sd = quality.get(name, 0.0), quality.get(sd_name, 0.0)
    return value if abs(value) > max(limit, _ERRORS * sd) else None


# --- Largest cell that measures the map's highest bump well, and what finer cells would cost.

_FWHM = 2.3548  # of a Gaussian, in sigmas
_CELL_PER_SIGMA = 0.5  #: Largest cell, in sigmas, that moved no width by more than one posterior SD (record 0074).
_SMOOTHED_CELLS = 2.0  # variance that `smooth` adds, in cells squared
_LEAST_RISE = 4.0  #: Least height of a peak that has a width, over half the smoothed map's distance of quartiles.


class CellAdvice(Record):
    """Advice on the size of the cells."""

    sigma_mm: float  #: Width of the narrower side of the map's highest bump, from its half height.
    coarsest_mm: float  #: Largest cell that leaves its widths within one posterior SD of those by cells of 1 mm.
    cell_mm: float  #: Side of the map's cells.
    readings: float  #: Median readings per cell.

    def text(self) -> str:
        """Line on the cells that measure the bump, and on the cost of cells of half the present size."""
        half = self.cell_mm / 2
        head = f"bump of sigma {self.sigma_mm:.1f} mm: measured well by cells of up to {self.coarsest_mm:.1f} mm"
        if self.cell_mm > self.coarsest_mm:
            return f"{head}, these are too coarse; use --cell-mm {math.floor(10 * self.coarsest_mm) / 10:g}"
        return f"{head}; {half:g} mm would take 4 times the cells with {self.readings / 4:.0f} readings each"


def advise_cell(tactile_map: TactileMap) -> CellAdvice | None:
    """Advice on the cell from a map's highest bump, h <= 0.5 sigma_min (record 0074); None where nothing stands out."""
    # the map smoothed with its counts as weights, where readings are not few
    count = np.where(tactile_map.covered, tactile_map.count, 0).astype(np.float64)
    weight, total = smooth(count), smooth(np.where(tactile_map.covered, tactile_map.mean, 0.0) * count)
    known = tactile_map.covered & ~tactile_map.few & (weight > 0)
    mean = np.divide(total, weight, out=np.full(weight.shape, np.nan), where=known)
    if np.count_nonzero(known) < 25:
        return None
    low, level, high = np.quantile(mean[known], [0.25, 0.5, 0.75])
    row, column = np.unravel_index(int(np.nanargmax(mean)), mean.shape)
    rise = float(mean[row, column] - level)
    if not rise > _LEAST_RISE * float(high - low) / 2:
        return None
    extents = [_extent(line - level, at) for line, at in ((mean[row], int(column)), (mean[:, column], int(row)))]
    if not all(np.isfinite(extents)):
        return None
    cell = tactile_map.recipe.cell_mm
    variances = [(extent * cell / _FWHM) ** 2 - _SMOOTHED_CELLS * cell**2 - cell**2 / 12 for extent in extents]
    sigma = float(np.sqrt(max(min(variances), (cell / 2) ** 2)))
    readings = float(np.median(tactile_map.count[tactile_map.covered]))
    return CellAdvice(sigma, _CELL_PER_SIGMA * sigma, cell, readings)


def _extent(excess: FloatArray, peak: int) -> float:
    """Full width at half height about the peak's index, in cells, interpolated; NaN where it reaches the rim."""
    half = excess[peak] / 2
    width = 0.0
    for step in (1, -1):
        i = peak
        while 0 <= i + step < len(excess) and excess[i + step] > half:
            i += step
        if not 0 <= i + step < len(excess) or not np.isfinite(excess[i + step]):
            return float("nan")
        width += abs(i - peak) + float((excess[i] - half) / (excess[i] - excess[i + step]))
    return width


def block_sums(values: FloatArray, side: int) -> FloatArray:
    """Sums over blocks of `side` by `side` cells; blocks at the ends are padded with zeros."""
    ny, nx = (-(-n // side) for n in values.shape)
    padded = np.zeros((ny * side, nx * side))
    padded[: values.shape[0], : values.shape[1]] = values
    summed: FloatArray = padded.reshape(ny, side, nx, side).sum(axis=(1, 3))
    return summed


# --- Orientation of a map on the screen: one rule for every picture.

PATIENT_WORDS: Final = "seen facing the patient: head up, patient's left on the right"
PLANE_WORDS: Final = "no landmarks: seen from outside, y (along the head) up, x to the left"
GRID_WORDS: Final = "as the imported file reads: first row on top, x to the right, y down"
_PATIENT_SIDES: Final = {
    "R": "the patient's right",
    "L": "the patient's left",
    "H": "the patient's head",
    "F": "the patient's feet",
}


class Orientation(Record):
    """Axes of the plane that point right and up on the screen."""

    right: str
    up: str
    """`right`, `up`: ``"+x"``, ``"-x"``, ``"+y"`` or ``"-y"``. Of the eight pairs only four are used: z, into the
    tissue, always points away from the viewer."""
    words: str  #: The orientation in a phrase, for captions.
    notch: tuple[float, float] | None = None
    """(2,) tuple or None: Unit vector to the sternal notch on the screen (to the right, upwards); None without
    landmarks."""

    @property
    def swapped(self) -> bool:
        """True where y, not x, runs across the screen."""
        return self.right[1] == "y"

    @property
    def edges(self) -> Mapping[str, str]:
        """Labels of the picture's edges: the patient's R, L, H (head), F (feet), or else an axis."""
        if self.notch is not None:
            return {"left": "R", "right": "L", "top": "H", "bottom": "F"}
        return {"left": _opposite(self.right), "right": self.right, "top": self.up, "bottom": _opposite(self.up)}

    @property
    def sentence(self) -> str:
        """Sentence for pages: the orientation, and the meaning of the letters at the edges."""
        sides = "; R, L: the patient's right and left; H: head, F: feet" if self.notch is not None else ""
        return f"{capitalised(self.words)}{sides}."

    def side_words(self, axis: str) -> str:
        """Name of a side of the map ("+x", "-x", "+y", "-y"): the patient's with landmarks, else the picture's."""
        screen = {self.right: "right", _opposite(self.right): "left", self.up: "top", _opposite(self.up): "bottom"}
        side = screen[axis]
        words = f"the picture's {side}" if self.notch is None else _PATIENT_SIDES[self.edges[side]]
        return f"{words} ({axis})"

    def screen(self, values: NDArray[Any]) -> NDArray[Any]:
        """The (ny, nx) values of a map as the rows of a picture: row 0 on top, column 0 on the left."""
        across = values if not self.swapped else values.T
        columns = across if self.right[0] == "+" else across[:, ::-1]
        return columns[::-1] if self.up[0] == "+" else columns

    def place(self, tactile_map: TactileMap, centre_mm: tuple[float, float]) -> tuple[float, float]:
        """Position of a point of the plane in the picture, in cells from its left and top edges."""
        axes = {"x": tactile_map.x_mm, "y": tactile_map.y_mm}
        point = dict(zip("xy", centre_mm, strict=True))
        half, cell = tactile_map.recipe.cell_mm / 2, tactile_map.recipe.cell_mm

        def along(axis: str) -> float:
            if axis[0] == "+":
                return float(point[axis[1]] - axes[axis[1]][0] + half) / cell
            return float(axes[axis[1]][-1] + half - point[axis[1]]) / cell

        return along(self.right), along(_opposite(self.up))


def orientation_of(tactile_map: TactileMap) -> Orientation:
    """Orientation of a map on the screen, seen along z, into the tissue (record 0076).

    With landmarks by the quarter turn that brings the sternal notch nearest to straight up; without them with y up and
    x to the left; an imported grid as its file reads.
    """
    if tactile_map.patient_from_plane is None and tactile_map.plane_from_base is None:
        return Orientation("+x", "-y", GRID_WORDS)
    if tactile_map.patient_from_plane is None:
        return Orientation("-x", "+y", PLANE_WORDS)
    notch = tactile_map.patient_from_plane[1, :2]
    x, y = (notch / np.hypot(*notch)).tolist()
    along = {"+y": y, "-y": -y, "+x": x, "-x": -x}
    up = max(along, key=lambda axis: along[axis])
    return Orientation(_RIGHT_OF_UP[up], up, PATIENT_WORDS, (along[_RIGHT_OF_UP[up]], along[up]))


# Axis to the right for each axis that is up, where z points away from the viewer.
_RIGHT_OF_UP: Final = {"+y": "-x", "-y": "+x", "+x": "+y", "-x": "-y"}


def _opposite(axis: str) -> str:
    return ("-" if axis[0] == "+" else "+") + axis[1]
