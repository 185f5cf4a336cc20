"""Sums of frames in cells, of whole scans or frame by frame; gains, flat field and correlation of the errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.mapping import cells
from tactile_bayes.mapping.map import FEW_READINGS, MapRecipe, TactileMap
from tactile_bayes.mapping.profile import GrowingProfile
from tactile_bayes.mapping.select import SelectedFrames, chunks, gate
from tactile_bayes.presets import CELL_MM, PRESSURE_WINDOW_KPA
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.scans import CountArray, ElementCalibration, HeadGeometry, HeadShape, Scan

# --- Used frames of a scan on the map's lattice.


class FrameSource(Record, eq=False):
    """Used frames of one scan, which can be read in chunks any number of times."""

    selection: SelectedFrames  #: The scan with its used frames.
    projection: cells.Projection  #: The used frames only, in their order.

    @property
    def frames(self) -> IndexArray:
        """Indices of the used frames in the scan."""
        return np.flatnonzero(self.selection.used)

    def parts(self, size: int) -> Iterator[tuple[slice, CountArray]]:
        """Slices of at most `size` used frames, with their (f, k) counts."""
        frames, counts = self.frames, self.selection.scan.frames.counts
        for part in chunks(len(frames), size):
            chosen = frames[part]
            gapless = chosen[-1] - chosen[0] == len(chosen) - 1  # such frames need not be copied
            yield part, self.selection.readout.counts(counts[chosen[0] : chosen[-1] + 1] if gapless else counts[chosen])


def frame_sources(
    selections: Sequence[SelectedFrames], *, plane_from_base: FloatArray, cell_mm: float
) -> list[FrameSource]:
    """The scans' used frames on one lattice."""
    projectors = [part.projector(plane_from_base=plane_from_base, cell_mm=cell_mm) for part in selections]
    pairs = zip(selections, projectors, strict=True)
    return [FrameSource(part, projector.at(part.poses.part(part.used))) for part, projector in pairs]


# --- Gains per frame, solved jointly with the map: dividing by the mean would lower the lump.

MAX_GAIN_PASSES = 50
GAIN_TOLERANCE = 1e-4
CACHED_READINGS = 2**24  #: Readings up to which all are cached between passes, at 17 bytes each.
_CHUNK = 128


def _solve_gains(
    sources: list[FrameSource], levels: list[FloatArray], *, progress: Progress
) -> tuple[list[FloatArray], int, float]:
    """Gains of the used frames, one array per scan, the number of passes, and the largest relative change in the last.

    Alternating least squares of pressure = gain of the frame x map at the cell, with every third step extrapolated on
    the logarithms of the gains (SQUAREM, Varadhan & Roland 2008, Scand. J. Statist. 35, scheme S3): frames far apart
    are tied only through those between them.
    """
    system = _GainSystem(sources, progress)
    ends = np.cumsum([len(level) for level in levels])[:-1]
    path = [np.log(np.concatenate(levels))]
    passes, change = 0, np.inf
    while change > GAIN_TOLERANCE and passes < MAX_GAIN_PASSES:
        path.append(np.log(system.improved_gains(np.exp(path[-1]))))
        change = float(np.abs(path[-1] - path[-2]).max(initial=0.0))
        passes += 1
        if len(path) == 3 and change > GAIN_TOLERANCE:
            path = [_extrapolated(*path)]
    return np.split(np.exp(path[-1]), ends), passes, change


def _extrapolated(start: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Limit of the steps from `start` over `first` to `second`, by extrapolation."""
    step = first - start
    curvature = second - first - step
    size = float(np.linalg.norm(curvature))
    if not size > 0:
        return second
    length = max(1.0, float(np.linalg.norm(step)) / size)
    return start + 2 * length * step + length**2 * curvature


_Chunk = tuple[NDArray[np.integer], FloatArray, BoolArray | None]


class _GainSystem:
    """All used frames of all scans on one block of cells."""

    def __init__(self, sources: list[FrameSource], progress: Progress) -> None:
        self._sources, self._progress = sources, progress
        blocks = [source.projection.block() for source in sources if len(source.projection)]
        top, left = np.min([first for first, _ in blocks], axis=0).tolist()
        bottom, right = np.max([np.add(*block) for block in blocks], axis=0).tolist()
        self._first, self._shape = (top, left), (bottom - top, right - left)
        cells.refuse_vast(*self._shape, sources[0].projection.cell_mm)
        self._readings = sum(len(source.projection) * len(source.selection.readout.taxels) for source in sources)
        self._cache: dict[tuple[int, int], _Chunk] = {}
        self._count = self._total(None)

    def improved_gains(self, gains: FloatArray) -> FloatArray:
        """Least-squares gain of each frame against the map of all frames with `gains`: sum(p m) / sum(m^2)."""
        total = self._total(gains)
        mean = np.divide(total, self._count, out=np.zeros_like(total), where=self._count > 0)
        improved = np.empty(len(gains))
        for frames, flat, pressure, valid in self._chunks():
            expected = mean[flat]
            if valid is not None:
                expected *= valid
            products = np.einsum("fk,fk->f", pressure, expected)
            improved[frames] = products / np.einsum("fk,fk->f", expected, expected)
        return improved

    def _total(self, gains: FloatArray | None) -> FloatArray:
        """Sum over each cell's readings of their pressure over their frame's gain; without gains, their number."""
        size = self._shape[0] * self._shape[1]
        total = np.zeros(size)
        for frames, flat, pressure, valid in self._chunks():
            counted = np.ones_like(pressure) if valid is None else valid
            weight = counted if gains is None else pressure / gains[frames, None]
            total += np.bincount(flat.ravel(), weight.ravel(), size)
        return total

    def _chunks(self) -> Iterator[tuple[slice, *_Chunk]]:
        """Chunks of frames: their slice, their readings' cells, pressures (0 where invalid) and validity."""
        start, total = 0, sum(len(source.projection) for source in self._sources)
        for number, source in enumerate(self._sources):
            for part, counts in source.parts(_CHUNK):
                yield slice(start, start + len(counts)), *self._chunk(number, part, counts)
                start += len(counts)
                self._progress(start, total)

    def _chunk(self, number: int, part: slice, counts: CountArray) -> _Chunk:
        if (number, part.start) in self._cache:
            return self._cache[number, part.start]
        source = self._sources[number]
        pressure, valid = source.selection.readout.pressure_kpa(counts)
        if valid is not None:
            pressure *= valid
        chunk = source.projection.part(part).flat(self._first, self._shape), pressure, valid
        if self._readings <= CACHED_READINGS:
            self._cache[number, part.start] = chunk
        return chunk


# --- Response of each taxel to an even pressure, from frames without a lump.

MOST_FRAMES = 4096  #: Frames that are read, spread evenly over the scan.
# A frame is lump-free when its departure from the head's usual profile is within this factor of the tenth percentile;
# there must be this many of them.
CALM_FACTOR = 1.1
LEAST_FRAMES = 50


def divided(scan: Scan, response: FloatArray) -> Scan:
    """Copy of the scan with its calibration divided by the (rows, columns) response of its taxels."""
    stated = scan.element_calibration
    gain, offset = stated.gain_kpa_per_count / response, stated.offset_kpa / response
    return replace(scan, element_calibration=replace(stated, gain_kpa_per_count=gain, offset_kpa=offset))


def flat_field(selection: SelectedFrames) -> tuple[FloatArray, int]:
    """(rows, columns) mean response of the taxels over the lump-free frames of a scan, and the number of these.

    It is 1 where a taxel reads as much as its frame's mean, and for taxels left out. Frames near the taxels' medians
    over frames are lump-free; a lump under most frames is flattened away. `BadDataError` for too few such frames.
    """
    good = selection.good_taxels
    frames = np.flatnonzero(selection.used)
    frames = frames[:: max(1, len(frames) // MOST_FRAMES)][:MOST_FRAMES]
    pressure, valid = selection.pressure_kpa(frames)
    ratio = pressure / selection.level_kpa[frames, None]
    profile = ratio if valid is None else np.where(valid, ratio, 1.0)
    departure = np.sqrt(np.square(profile - np.median(profile, axis=0)).mean(axis=1))
    calm = departure <= CALM_FACTOR * float(np.quantile(departure, 0.1))
    if valid is not None:
        calm &= valid.all(axis=1)
    if np.count_nonzero(calm) < LEAST_FRAMES:
        raise BadDataError(
            f"only {np.count_nonzero(calm)} of {len(frames)} frames look free of a lump",
            way_out=f"scan beside the lump too ({LEAST_FRAMES} frames are needed), or leave out the flat field",
        )
    response = np.ones(good.shape)
    response[good] = np.clip(ratio[calm].mean(axis=0), 0.05, None)
    return response, int(np.count_nonzero(calm))


# --- Normalise the frames and average them in cells (paper steps ii and iii).


class Accumulated(Record, eq=False):
    """Sums over all frames, and the solution for their gains."""

    sums: cells.CellSums
    levels: list[FloatArray]  #: Divisors of the frames, one array per scan.
    scale: float = 1.0
    """Divisor of the sums' values: 1, or with ``gain`` the median of the cells, most of which lie beside a lump."""
    passes: int = 1  #: Passes over the scan.
    last_change: float = 0.0  #: Largest relative change of a gain in the last pass; 0 without gains.


def accumulate(
    sources: list[FrameSource], *, cell_mm: float, normalise: str, progress: Progress = no_progress
) -> Accumulated:
    """Average the normalised readings of all used frames in cells on the plane; progress starts anew in each pass.

    ``"mean"`` divides each frame by its mean over the valid taxels, as the paper does, which takes part of the lump
    away (record 0065); ``"gain"`` solves for a gain per frame jointly with the map; ``"none"`` keeps kPa.
    """
    levels = [source.selection.level_kpa[source.selection.used] for source in sources]
    if normalise == "none":
        levels = [np.ones(len(level)) for level in levels]
    if normalise != "gain":
        return Accumulated(add_all(sources, levels, cell_mm=cell_mm, progress=progress), levels)
    gains, passes, last_change = _solve_gains(sources, levels, progress=progress)
    sums = add_all(sources, gains, cell_mm=cell_mm, progress=progress)
    return Accumulated(sums, gains, float(np.nanmedian(sums.mean())), passes, last_change)


def add_all(
    sources: list[FrameSource], levels: list[FloatArray], *, cell_mm: float, progress: Progress = no_progress
) -> cells.CellSums:
    """Sums over all used frames, each divided by its level."""
    sums = cells.CellSums(cell_mm)
    done, total = 0, sum(len(source.projection) for source in sources)
    for source, level in zip(sources, levels, strict=True):
        for part, counts in source.parts(cells.chunk_frames(source.selection.readout.size)):
            pressure, valid = source.selection.readout.pressure_kpa(counts)
            projection = source.projection.part(part)
            cells.add_frames(sums, pressure, valid, projection=projection, level=level[part])
            done += len(counts)
            progress(done, total)
    return sums


# --- A map that grows frame by frame, to the same bits as one of whole scans.


class MapAccumulator:
    """Map that grows by frames, in any portions and order, each divided by its mean, and can be read at any time."""

    def __init__(self, head: HeadGeometry, calibration: ElementCalibration, *, plane_from_base: FloatArray) -> None:
        self.plane_from_base = plane_from_base
        taxels = np.ones(head.shape, dtype=bool)
        self._head, self._readout = head, cells.Readout.of(calibration, taxels)
        self._projector = cells.Projector(head, plane_from_base=plane_from_base, taxels=taxels, cell_mm=CELL_MM)
        self._sums, self._profile = cells.CellSums(CELL_MM), GrowingProfile(taxels)
        dropped = ("dropped_no_pose", "dropped_elements", "dropped_low", "dropped_high")
        self._counters = Counter(dict.fromkeys(("frames_total", "frames_used", *dropped, "saturated_readings"), 0))

    @property
    def figures(self) -> dict[str, float]:
        """Numbers of frames and readings so far, used and left out by reason."""
        more = {"clipped_values": self._sums.clipped, "negative_readings": self._sums.negative}
        return {name: float(value) for name, value in {**self._counters, **more}.items()}

    def add(self, counts: CountArray, poses: cells.FramePoses) -> BoolArray:
        """Add (n, rows, columns) frames with the n poses at their times; returns an (n,) mask of the used ones."""
        parts = chunks(len(counts), cells.chunk_frames(self._readout.size))
        used = [self._add(self._readout.counts(counts[part]), poses.part(part)) for part in parts]
        return np.concatenate([np.zeros(0, dtype=bool), *used])

    def _add(self, counts: CountArray, poses: cells.FramePoses) -> BoolArray:
        pressure, valid = self._readout.pressure_kpa(counts)
        level, share = self._readout.levels(pressure, valid)
        low, high, used = gate(poses.known, level, share, pressure_window_kpa=PRESSURE_WINDOW_KPA)
        dropped = {"dropped_no_pose": ~poses.known, "dropped_low": low, "dropped_high": high}
        dropped["dropped_elements"] = ~(used | low | high | ~poses.known)
        self._counters.update({name: int(np.count_nonzero(mask)) for name, mask in dropped.items()})
        self._counters["frames_total"] += len(used)
        if not used.any():
            return used
        frames = slice(None) if used.all() else used  # nothing is copied where all are used
        poses, pressure, level, share = poses.part(frames), pressure[frames], level[frames], share[frames]
        self._counters["frames_used"] += len(level)
        self._counters["saturated_readings"] += round(float((1 - share).sum()) * self._readout.size)
        self._profile.add(pressure, level, share)
        valid, projection = None if valid is None else valid[frames], self._projector.at(poses)
        cells.add_frames(self._sums, pressure, valid, projection=projection, level=level)
        return used

    def snapshot(self) -> TactileMap:
        """A copy of the map so far, without `shared_frame_figures`; it has no cell before the first frame."""
        return TactileMap(
            **self._sums.trimmed().map_arrays(),
            recipe=MapRecipe("scan", "mean", CELL_MM, PRESSURE_WINDOW_KPA),
            plane_from_base=self.plane_from_base,
            frame_count=self._counters["frames_used"],
            quality=self.figures | self._profile.figures(),
            head=HeadShape.of(self._head.surface_mm, self._head.pitch_mm),
        )


# --- Correlation of the errors within a frame (record 0047): of readings about the map, so it holds all that neighbours
# share: the frame's level, the pose, the slope within a cell, a response that the calibration left.

# Runs of successive frames, spread evenly over the scan: enough pairs for a correlation to 0.01, at 400 frames' cost.
RUNS = 16
RUN_FRAMES = 25
# Fewest runs, and fewest readings in cells that other frames made too, for an estimate.
LEAST_RUNS = 2
LEAST_READINGS = 1000
REACH_PITCHES = 8  #: Largest distance of the neighbours that are compared, in taxel pitches.
LEAST_SHARE = 0.02  #: Least share of the error variance for which a length is given.
LONGEST_MM = 100.0  #: Longest length that is fitted.
_LENGTHS = 400


def shared_frame_figures(
    sources: Sequence[FrameSource], levels: Sequence[FloatArray], sums: cells.CellSums
) -> dict[str, float]:
    """Figures of the error correlation within a frame, from `RUNS` x `RUN_FRAMES` of the frames in `sums`.

    ``shared_share`` of a reading's error variance is common to its neighbours in the frame; it falls by e over
    ``shared_length_mm``: correlation = share x exp(-d / length). The readings of the median cell are worth
    ``effective_readings`` independent ones, by what they share within a run. ``shared_frames`` were read. Empty for too
    few frames, or readings without scatter.

    A product of errors takes one about the map of all frames and one about the map without the run: then its mean is
    the covariance, however few readings a cell has.
    """
    frames = sum(len(source.projection) for source in sources)
    runs = [
        _Run.of(source, level, sums, run)
        for source, level in zip(sources, levels, strict=True)
        for run in _sampled(source, frames)
    ]
    readings = sum(int(np.count_nonzero(run.known)) for run in runs)
    if len(runs) < LEAST_RUNS or readings < LEAST_READINGS:
        return {}
    variance = sum(float(np.einsum("fk,fk->", run.error, run.error_without)) for run in runs) / readings
    if not variance > cells.VALUE_STEP**2:
        return {}
    share, length_mm = _fit_decay(*_correlations(sources, runs, variance))
    figures = {
        "shared_share": share,
        "shared_length_mm": length_mm,
        "effective_readings": float(np.median(sums.count[sums.count > 0])) / _inflation(runs, variance * readings),
        "shared_frames": float(sum(len(run.error) for run in runs)),
    }
    if share < LEAST_SHARE:
        del figures["shared_length_mm"]
    return {name: float(f"{value:.6g}") for name, value in figures.items()}


def _sampled(source: FrameSource, all_frames: int) -> list[slice]:
    """Evenly spaced runs of successive used frames of a scan: its part of `RUNS` over scans of `all_frames`."""
    frames = len(source.projection)
    length = min(RUN_FRAMES, all_frames // LEAST_RUNS, frames)
    if not length:
        return []
    number = min(round(RUNS * frames / all_frames), frames // length)
    starts = np.linspace(0, frames - length, number).astype(int)
    return [slice(start, start + length) for start in starts.tolist()]


class _Run(Record, eq=False):
    """Errors of one run of frames; (f, k) arrays, 0 where not known."""

    source: FrameSource  #: Scan of the run.
    cell: NDArray[np.int64]  #: Cell of each reading in the block of cells that the run covers.
    size: int  #: Number of cells of the block.
    error: FloatArray  #: Readings less the map.
    error_without: FloatArray  #: Readings less the map of the other frames.
    known: BoolArray  #: Mask of the valid readings in cells with enough readings of other frames.

    @classmethod
    def of(cls, source: FrameSource, level: FloatArray, sums: cells.CellSums, run: slice) -> _Run:
        pressure, valid = source.selection.pressure_kpa(source.frames[run])
        value = pressure / level[run, None]
        if valid is None:
            valid = np.ones(value.shape, dtype=bool)
        projection = source.projection.part(run)
        first, shape = projection.block()
        cell, window = projection.flat(first, shape), sums.window(first, shape)
        count, total = sums.count[window].ravel(), sums.total[window].ravel() * cells.VALUE_STEP
        other_count = count - np.bincount(cell[valid], minlength=len(count))
        other_total = total - np.bincount(cell[valid], value[valid], len(count))
        enough = other_count >= FEW_READINGS
        known = valid & enough[cell]
        mean = np.divide(total, count, out=np.zeros(len(count)), where=enough)
        other_mean = np.divide(other_total, other_count, out=np.zeros(len(count)), where=enough)
        error, error_without = (np.where(known, value - expected[cell], 0.0) for expected in (mean, other_mean))
        return cls(source, cell, len(count), error, error_without, known)


def _correlations(
    sources: Sequence[FrameSource], runs: Sequence[_Run], variance: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance (mm), correlation and pairs of taxels within a frame, in bins of one pitch; empty bins are left out."""
    totals = np.zeros((3, REACH_PITCHES + 1))
    for source in sources:
        of_source = [run for run in runs if run.source is source]
        if not of_source:
            continue
        place = source.projection.taxels[:3]
        distance = np.sqrt(sum((axis[:, None] - axis) ** 2 for axis in place))
        bins = np.minimum(np.rint(distance / source.selection.scan.head.pitch_mm).astype(int), REACH_PITCHES + 1)
        # every other frame is enough: one has 86,000 pairs
        error, error_without, known = (
            np.concatenate([getattr(run, name)[::2] for run in of_source])
            for name in ("error", "error_without", "known")
        )
        known = known.astype(np.float32)
        pairs = (known.T @ known).astype(np.float64)
        for row, weight in enumerate((pairs * distance, error.T @ error_without, pairs)):
            totals[row] += np.bincount(bins.ravel(), weight.ravel(), REACH_PITCHES + 2)[: REACH_PITCHES + 1]
    filled = np.flatnonzero(totals[2, 1:] > 0) + 1
    distance_mm, products, pairs = totals[:, filled]
    return distance_mm / pairs, products / pairs / variance, pairs


def _fit_decay(distance_mm: FloatArray, correlation: FloatArray, pairs: FloatArray) -> tuple[float, float]:
    """Share and length of ``share exp(-d / length)``, by least squares over the bins; no shorter than one pitch."""
    if not len(distance_mm):
        return 0.0, float("nan")
    lengths = np.geomspace(float(distance_mm[0]), LONGEST_MM, _LENGTHS)
    shape = np.exp(-distance_mm[None, :] / lengths[:, None])
    share = np.clip((shape * pairs) @ correlation / ((shape**2) @ pairs), 0.0, 1.0)
    misfit = ((correlation - share[:, None] * shape) ** 2) @ pairs
    best = int(np.argmin(misfit))
    return float(share[best]), float(lengths[best])


def _inflation(runs: Sequence[_Run], square: float) -> float:
    """Variance of a cell's mean over that of as many independent readings, at least 1; `square` sums their variances.

    A run has only a share 1 - n / `RUN_FRAMES` of the products between frames n apart, and they are weighted for that.
    """
    covariance = 0.0
    for run in runs:
        frames = len(run.error)
        place = (run.cell + np.arange(frames)[:, None] * run.size).ravel()
        sums = [
            np.bincount(place, error.ravel(), frames * run.size).reshape(frames, -1)
            for error in (run.error, run.error_without)
        ]
        products = sums[0] @ sums[1].T
        apart = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
        own = np.einsum("fk,fk->", run.error, run.error_without)
        covariance += float((products * (frames / (frames - apart))).sum() - own)
    return max(1.0, 1.0 + covariance / square)
