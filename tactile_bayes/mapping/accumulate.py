"""Frames added up in cells: those of whole scans, with gains and a flat field, or frame by frame as they come."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, Plane, check_rigid
from tactile_bayes.mapping.cells import CellSums, Projection, Projector, Readout, add_frames, chunk_frames
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.mapping.plane import FramePoses, HeadMoments, MomentSums, head_moments
from tactile_bayes.mapping.profile import GrowingProfile
from tactile_bayes.mapping.select import SelectedFrames, TaxelFault, chunks, gate, good_taxels
from tactile_bayes.presets import CELL_MM, PRESSURE_WINDOW_KPA
from tactile_bayes.progress import Progress, untold
from tactile_bayes.scans import CountArray, ElementCalibration, HeadGeometry, HeadShape, Scan

# --- Used frames of a scan on the map's lattice, which can be read any number of times.


class Source(Record, eq=False):
    """Used frames of one scan, which can be read chunk by chunk any number of times."""

    selection: SelectedFrames
    readout: Readout
    """`selection`, `readout`: The scan with its used frames, and the taxels that are read."""
    projection: Projection  #: The used frames only, in their order.

    @classmethod
    def of(cls, selection: SelectedFrames, *, plane_from_base: FloatArray, cell_mm: float) -> Source:
        """Project the used frames of a scan."""
        projector = selection.projector(plane_from_base=plane_from_base, cell_mm=cell_mm)
        return cls(selection, selection.readout, projector.at(selection.poses.part(selection.used)))

    @property
    def frames(self) -> IndexArray:
        """Indices of the used frames in the scan."""
        return np.flatnonzero(self.selection.used)

    def parts(self, size: int) -> Iterator[tuple[slice, CountArray]]:
        """Iterate over stretches of at most `size` used frames and their (f, k) counts."""
        frames, counts = self.frames, self.selection.scan.frames.counts
        for part in chunks(len(frames), size):
            chosen = frames[part]
            whole = chosen[-1] - chosen[0] == len(chosen) - 1  # a stretch without gaps need not be copied
            yield part, self.readout.counts(counts[chosen[0] : chosen[-1] + 1] if whole else counts[chosen])


def sources_of(selections: list[SelectedFrames], *, plane_from_base: FloatArray, cell_mm: float) -> list[Source]:
    """Put the scans on one lattice."""
    return [Source.of(part, plane_from_base=plane_from_base, cell_mm=cell_mm) for part in selections]


# --- Gains per frame, solved jointly with the map: dividing by the mean would lower the lump.

MAX_GAIN_PASSES = 50
# Cells of this many readings are kept between passes (4 bytes each); beyond, they are found anew in every pass.
KEPT_READINGS = 2**26
_CHUNK = 128

# Of pressures (f, k), which are valid, and the frames they are of: what is added up.
_Weight = Callable[[FloatArray, "BoolArray | None", slice], "NDArray[np.generic]"]


class SolvedGains(Record, eq=False):
    """Gains of the used frames, one array per scan, and the course of the solution."""

    gains: list[FloatArray]
    passes: int
    last_change: float


def solve_gains(
    sources: list[Source], levels: list[FloatArray], *, tolerance: float, progress: Progress = untold
) -> SolvedGains:
    """Alternate between the map, given the gains, and each frame's least-squares gain, given the map.

    The model is pressure = gain of the frame x map at the cell. Only the product is determined: the level is set in the
    end so that the median of the map's cells is 1, since most cells lie beside the lump. Frames far apart are tied only
    through those between them, so plain alternation creeps. Every third step extrapolates along the direction of the
    last two (SQUAREM, Varadhan & Roland 2008, Scand. J. Statist. 35, scheme S3), on the logarithms of the gains.
    """
    system = _System(sources, progress)
    ends = np.cumsum([len(level) for level in levels])[:-1]
    path = [np.log(np.concatenate(levels))]
    passes, change = 0, np.inf
    while change > tolerance and passes < MAX_GAIN_PASSES:
        path.append(np.log(system.improved(np.exp(path[-1]))))
        change = float(np.abs(path[-1] - path[-2]).max(initial=0.0))
        passes += 1
        if len(path) == 3 and change > tolerance:
            path = [_extrapolated(*path)]
    return SolvedGains(np.split(np.exp(path[-1]), ends), passes, change)


def _extrapolated(start: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Limit of the steps from `start` over `first` to `second`, by extrapolation."""
    step = first - start
    bend = second - first - step
    size = float(np.linalg.norm(bend))
    if not size > 0:
        return second
    length = max(1.0, float(np.linalg.norm(step)) / size)
    return start + 2 * length * step + length**2 * bend


class _System:
    """All used frames of all scans on one block of cells."""

    def __init__(self, sources: list[Source], progress: Progress) -> None:
        self._sources, self._progress = sources, progress
        blocks = [source.projection.block() for source in sources if len(source.projection)]
        self._first = (min(first[0] for first, _ in blocks), min(first[1] for first, _ in blocks))
        self._shape = (
            max(first[0] + shape[0] for first, shape in blocks) - self._first[0],
            max(first[1] + shape[1] for first, shape in blocks) - self._first[1],
        )
        readings = sum(len(source.projection) * len(source.readout.taxels) for source in sources)
        self._kept: dict[tuple[int, int], NDArray[np.int32]] | None = {} if readings <= KEPT_READINGS else None
        self._count = self._sum(lambda pressure, valid, _: np.ones_like(pressure) if valid is None else valid)

    def improved(self, gains: FloatArray) -> FloatArray:
        """Least-squares gain of each frame against the map of all frames with `gains`: sum(p m) / sum(m^2)."""
        total = self._sum(lambda pressure, _, frames: pressure / gains[frames, None])
        mean = np.divide(total, self._count, out=np.zeros_like(total), where=self._count > 0)
        better = np.empty(len(gains))
        for frames, flat, pressure, valid in self._parts():
            expected = mean[flat]
            if valid is not None:
                expected *= valid
            products = np.einsum("fk,fk->f", pressure, expected)
            better[frames] = products / np.einsum("fk,fk->f", expected, expected)
        return better

    def _sum(self, weight: _Weight) -> FloatArray:
        """Sum of a weight over all readings of each cell."""
        cells = self._shape[0] * self._shape[1]
        total = np.zeros(cells)
        for frames, flat, pressure, valid in self._parts():
            total += np.bincount(flat.ravel(), weight(pressure, valid, frames).ravel(), cells)
        return total

    def _parts(self) -> Iterator[tuple[slice, NDArray[np.integer], FloatArray, BoolArray | None]]:
        """Chunks: frames' indices, their cells, pressures (0 where not valid) and which are valid."""
        start, total = 0, sum(len(source.projection) for source in self._sources)
        for number, source in enumerate(self._sources):
            for part, counts in source.parts(_CHUNK):
                pressure, valid = source.readout.pressure_kpa(counts)
                if valid is not None:
                    pressure *= valid
                yield slice(start, start + len(counts)), self._flat(number, part), pressure, valid
                start += len(counts)
                self._progress(start, total)

    def _flat(self, number: int, part: slice) -> NDArray[np.integer]:
        if self._kept is not None and (number, part.start) in self._kept:
            return self._kept[number, part.start]
        flat = self._sources[number].projection.part(part).flat(self._first, self._shape)
        if self._kept is not None:
            self._kept[number, part.start] = flat.astype(np.int32)
        return flat


# --- Response of each taxel to an even pressure, from frames without a lump.

# Frames that are looked at, spread evenly over the scan.
MOST_FRAMES = 4096
# A frame is called lump-free when its departure from the head's usual profile is within this factor of the calmest
# tenth's, and there must be this many of them.
CALM_FACTOR = 1.1
LEAST_FRAMES = 50


class FlatField(Record, eq=False):
    """Response of each taxel relative to the array's mean."""

    response: FloatArray
    """(rows, columns) array: 1 where the taxel reads as much as its frame's mean; 1 for taxels left out."""
    frames: int  #: Lump-free frames it was taken from.

    @property
    def spread(self) -> float:
        """Standard deviation of the response."""
        return float(self.response.std())

    def applied(self, scan: Scan) -> Scan:
        """Copy of the scan with its calibration divided by the response."""
        calibration = scan.element_calibration
        flat = replace(
            calibration,
            gain_kpa_per_count=calibration.gain_kpa_per_count / self.response,
            offset_kpa=calibration.offset_kpa / self.response,
        )
        return replace(scan, element_calibration=flat)


def flat_field(selection: SelectedFrames) -> FlatField:
    """Estimate the taxels' response over the lump-free frames of a scan; `BadDataError` when too few frames look alike.

    The usual profile of the head is each taxel's median over frames, which a lump under a minority of them does not
    move. Frames that depart from it no more than the calmest ones are lump-free; their mean is the response. A lump
    under most frames would be taken for the head's own profile and be flattened away.
    """
    scan, good = selection.scan, selection.good_taxels
    frames = np.flatnonzero(selection.used)
    frames = frames[:: max(1, len(frames) // MOST_FRAMES)][:MOST_FRAMES]
    readout = selection.readout
    pressure, valid = readout.pressure_kpa(readout.counts(scan.frames.counts[frames]))
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
    return FlatField(response, int(np.count_nonzero(calm)))


# --- Normalise the frames and average them in cells (paper steps ii and iii).

GAIN_TOLERANCE = 1e-4


class Accumulated(Record, eq=False):
    """Sums over all frames, and how the gains were solved."""

    sums: CellSums  #: The cells.
    levels: list[FloatArray]  #: Divisors of the frames, one array per scan.
    scale: float = 1.0  #: Divisor of the sums' values (1 but for ``gain``, whose level is set afterwards).
    passes: int = 1  #: Passes over the scan.
    last_change: float = 0.0
    """Largest relative change of a frame's gain in the last pass; 0 unless the gains are solved for."""

    @property
    def settled(self) -> bool:
        """True where the gains converged."""
        return self.last_change <= GAIN_TOLERANCE


def accumulate(sources: list[Source], *, cell_mm: float, normalise: str, progress: Progress = untold) -> Accumulated:
    """Average the normalised readings of all used frames in cells on the plane; progress starts anew in each pass.

    ``"mean"`` divides each frame by its mean over the valid taxels, as the paper does. A lump under the head is in that
    mean, so the map's amplitude and widths come out low by a few per cent. ``"gain"`` solves for one gain per frame
    jointly with the map. ``"none"`` keeps kPa.
    """
    levels = [source.selection.level_kpa[source.selection.used] for source in sources]
    if normalise == "none":
        levels = [np.ones(len(level)) for level in levels]
    if normalise != "gain":
        return Accumulated(add_all(sources, levels, cell_mm=cell_mm, progress=progress), levels)
    solved = solve_gains(sources, levels, tolerance=GAIN_TOLERANCE, progress=progress)
    sums = add_all(sources, solved.gains, cell_mm=cell_mm, progress=progress)
    return Accumulated(sums, solved.gains, float(np.nanmedian(sums.mean())), solved.passes, solved.last_change)


def add_all(
    sources: list[Source], levels: list[FloatArray], *, cell_mm: float, progress: Progress = untold
) -> CellSums:
    """One pass over all used frames, each divided by its level."""
    sums = CellSums(cell_mm)
    done, total = 0, sum(len(source.projection) for source in sources)
    for source, level in zip(sources, levels, strict=True):
        for part, counts in source.parts(chunk_frames(source.readout.size)):
            pressure, valid = source.readout.pressure_kpa(counts)
            projection = source.projection.part(part)
            add_frames(sums, source.readout, pressure, valid, projection=projection, level=level[part])
            done += len(counts)
            progress(done, total)
    return sums


# --- A map that grows frame by frame; live, sharded and one-pass building end in the same bits.

_TALLIES = ("frames_total", "frames_used", "dropped_no_pose", "dropped_elements", "dropped_low", "dropped_high")

# Frames that are projected at once.
_PORTION = 4096


class MapGrid(Record, eq=False):
    """Lattice of a map's cells on a plane."""

    plane_from_base: FloatArray
    """(4, 4) array: Cells are centred on whole multiples of their side in this `plane`."""
    cell_mm: float = CELL_MM  #: Side of the square cells.

    def __post_init__(self) -> None:
        check_rigid(self.plane_from_base, name="plane_from_base")
        if not (np.isfinite(self.cell_mm) and self.cell_mm > 0):
            raise BadDataError(f"cell_mm is {self.cell_mm}", way_out="it must be positive, in mm")

    @classmethod
    def under(cls, head: HeadGeometry, poses: FramePoses, *, cell_mm: float = CELL_MM) -> MapGrid:
        """Grid on the best-fit plane of the known `poses`, for the start of a recording."""
        return cls(head_moments(head, poses).plane().plane_from_base, cell_mm)

    def same(self, other: MapGrid) -> bool:
        """True where another grid is equal to the bit."""
        return self.cell_mm == other.cell_mm and np.array_equal(self.plane_from_base, other.plane_from_base)


class Instrument(Record, eq=False, dict=True):
    """Conversion of counts and poses to pressures on a plane, and the rules for frames that count."""

    head: HeadGeometry
    element_calibration: ElementCalibration
    """`head`, `element_calibration`: Of the scan head."""
    faults: Sequence[TaxelFault] = ()  #: Taxels left out of every frame.
    pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA
    """Frames whose mean lies outside are left out."""
    normalise: str = "mean"
    """``"mean"`` or ``"none"``. A gain per frame needs all frames at once: see `mapping.build.build_map`."""

    def __post_init__(self) -> None:
        if self.normalise not in ("mean", "none"):
            raise UsageError(f"frames cannot be added one by one with normalise {self.normalise!r}; use mean or none")

    @cached_property
    def readout(self) -> Readout:
        """The taxels used, and the conversion of their counts."""
        return Readout.of(self.element_calibration, self.good)

    @property
    def good(self) -> BoolArray:
        """(rows, columns) True for taxels that are used."""
        return good_taxels(self.head.shape, self.faults)

    def differs(self, other: Instrument) -> str:
        """Name of the first setting that differs; empty if none does."""
        arrays = (
            ("head", self.head.surface_mm, other.head.surface_mm),
            ("lever arm", self.head.scanhead_from_tracker, other.head.scanhead_from_tracker),
            ("element calibration", self.readout.gain_kpa, other.readout.gain_kpa),
            ("element calibration", self.readout.offset_kpa, other.readout.offset_kpa),
            ("set of taxels left out", self.readout.taxels, other.readout.taxels),
            ("saturation count", np.array(self.readout.full_count), np.array(other.readout.full_count)),
            ("pressure window", np.array(self.pressure_window_kpa), np.array(other.pressure_window_kpa)),
            ("way to normalise", np.array(self.normalise), np.array(other.normalise)),
        )
        return next((name for name, one, two in arrays if not np.array_equal(one, two)), "")


class MapAccumulator:
    """Accumulates frames, in any portions and order, into a map that can be read at any time.

    Everything that is added up is a whole number of tiny steps (`CellSums`, `HeadMoments`, `Readout`), so neither
    portions nor order leave a trace. `rebuild` needs `keep_frames`, which keeps counts and poses (0.9 kB a frame of 416
    taxels); without it memory grows with the number of cells only.
    """

    def __init__(self, grid: MapGrid, instrument: Instrument, *, keep_frames: bool = True) -> None:
        self.grid, self.instrument = grid, instrument
        self._sums = CellSums(grid.cell_mm)
        self._projector = Projector(
            instrument.head, plane_from_base=grid.plane_from_base, taxels=instrument.good, cell_mm=grid.cell_mm
        )
        self._moments, self._merged = MomentSums(instrument.head), HeadMoments.none()
        self._tally = dict.fromkeys(_TALLIES, 0)
        self._saturated = 0
        self._profile = GrowingProfile(instrument.good, instrument.readout)
        self._kept: list[tuple[CountArray, FramePoses]] | None = [] if keep_frames else None

    @property
    def figures(self) -> dict[str, float]:
        """Frames and readings so far, used and left out by reason."""
        more = {
            "saturated_readings": self._saturated,
            "clipped_values": self._sums.clipped,
            "negative_readings": self._sums.negative,
            "masked_taxels": len(self.instrument.faults),
        }
        return {name: float(value) for name, value in (self._tally | more).items()}

    def add(self, counts: CountArray, poses: FramePoses) -> int:
        """Add (n, rows, columns) uint16 frames with the n poses at their times; returns how many were used."""
        if counts.dtype != np.uint16 or counts.shape != (len(poses.known), *self.instrument.head.shape):
            raise BadDataError(
                f"counts is {counts.dtype} of shape {counts.shape} for {len(poses.known)} poses",
                way_out="give uint16 (n, rows, columns), one pose per frame",
            )
        if self._kept is not None:
            self._kept.append((counts, poses))
        if len(counts) <= _PORTION:
            return self._add(counts, poses) if len(counts) else 0
        return sum(self._add(counts[part], poses.part(part)) for part in chunks(len(counts), _PORTION))

    def _add(self, counts: CountArray, poses: FramePoses) -> int:
        """Add a portion: projected and counted as a whole, read in chunks."""
        readout, projection = self.instrument.readout, self._projector.at(poses)
        size = chunk_frames(readout.size)
        if len(counts) <= size:
            used = self._read(readout.counts(counts), poses.known, projection)
        else:
            parts = chunks(len(counts), size)
            used = np.concatenate(
                [self._read(readout.counts(counts[p]), poses.known[p], projection.part(p)) for p in parts]
            )
        self._moments.add(FramePoses(poses.position_mm, poses.rotation, used))
        return int(np.count_nonzero(used))

    def _read(self, readings: CountArray, known: BoolArray, projection: Projection) -> BoolArray:
        """Add a chunk; return which of its frames are used."""
        instrument = self.instrument
        pressure, valid = instrument.readout.pressure_kpa(readings)
        level, share = instrument.readout.levels(pressure, valid)
        low, high, used = gate(known, level, share, pressure_window_kpa=instrument.pressure_window_kpa)
        number = self._count(known, low, high, used)
        if number < len(used):
            readings, projection, level, share = readings[used], projection.part(used), level[used], share[used]
            pressure, valid = pressure[used], None if valid is None else valid[used]
        if number:
            taxels, array = len(instrument.readout.taxels), instrument.readout.size
            self._saturated += round(number * taxels - float(share.sum()) * array)
            self._profile.add(readings, level, share)
            divisor = level if instrument.normalise == "mean" else np.ones(number)
            add_frames(self._sums, instrument.readout, pressure, valid, projection=projection, level=divisor)
        return used

    def _count(self, known: BoolArray, low: BoolArray, high: BoolArray, used: BoolArray) -> int:
        """Count each frame as used or under its reason; return the number used."""
        total, number = len(used), int(np.count_nonzero(used))
        refused = int(np.count_nonzero(low)), int(np.count_nonzero(high))
        unknown = total - int(np.count_nonzero(known))
        tallies = (total, number, unknown, total - number - sum(refused) - unknown, *refused)
        for name, value in zip(_TALLIES, tallies, strict=True):
            self._tally[name] += value
        return number

    def merge(self, other: MapAccumulator) -> None:
        """Add everything that another accumulator was given.

        Another lattice, plane, head, calibration or rule is a `BadDataError`: its sums mean something else.
        """
        differs = "" if self.grid.same(other.grid) else "plane or cell size"
        differs = differs or self.instrument.differs(other.instrument)
        if differs:
            raise BadDataError(
                f"maps of another {differs} cannot be merged", way_out="build both with the same one, or rebuild one"
            )
        self._sums.merge(other._sums)
        self._merged = self._merged + other._all_moments()
        self._saturated += other._saturated
        self._profile.merge(other._profile)
        for name in _TALLIES:
            self._tally[name] += other._tally[name]
        self._kept = None if self._kept is None or other._kept is None else self._kept + other._kept

    def plane(self) -> Plane:
        """Best-fit plane of the frames used so far; `BadDataError` when there are none, or they span no plane."""
        moments = self._all_moments()
        if not moments.count:
            raise BadDataError("no frame was used yet", way_out="press within the window and move the head")
        return moments.plane()

    def _all_moments(self) -> HeadMoments:
        moments = self._moments.moments()
        return self._merged + moments if self._merged.count else moments

    def rebuild(self) -> MapAccumulator:
        """Make a new accumulator from the frames kept so far, on their best-fit plane; `UsageError` when none were
        kept."""
        if self._kept is None:
            raise UsageError("the frames were not kept; make the accumulator with keep_frames=True")
        grid = MapGrid(self.plane().plane_from_base, self.grid.cell_mm)
        anew = MapAccumulator(grid, self.instrument)
        for counts, poses in self._kept:
            anew.add(counts, poses)
        return anew

    def snapshot(self) -> TactileMap:
        """The map so far, a copy; it has no cell before the first frame.

        What a frame's readings share (`tactile_bayes.mapping.errors`) is not in its quality: the errors of
        frames are not kept, and with the next frame they would be others.
        """
        sums, instrument = self._sums.trimmed(), self.instrument
        mean = sums.mean()
        window = (float(instrument.pressure_window_kpa[0]), float(instrument.pressure_window_kpa[1]))
        return TactileMap(
            mean=mean,
            variance=sums.variance(mean),
            count=sums.count,
            x_mm=sums.x_mm(),
            y_mm=sums.y_mm(),
            recipe=MapRecipe("scan", instrument.normalise, float(self.grid.cell_mm), window),
            plane_from_base=self.grid.plane_from_base,
            background=None if instrument.normalise == "none" else 1.0,
            frame_count=self._tally["frames_used"],
            quality=self.figures | self._profile.figures(),
            masked_taxels=tuple(str(fault) for fault in instrument.faults),
            head=HeadShape.of(instrument.head.surface_mm, instrument.head.pitch_mm),
        )
