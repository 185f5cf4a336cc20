"""A map that grows frame by frame; live, sharded and one-pass building end in the same bits."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.geometry import BoolArray, FloatArray, Plane, check_rigid
from tactile_bayes.mapping.cells import CellSums, Projection, Projector, Readout, add_frames, chunk_frames
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.mapping.plane import FramePoses, HeadMoments, MomentSums, head_moments
from tactile_bayes.mapping.profile import GrowingProfile
from tactile_bayes.mapping.select import TaxelFault, chunks, gate, good_taxels
from tactile_bayes.presets import CELL_MM, PRESSURE_WINDOW_KPA
from tactile_bayes.scan import CountArray, ElementCalibration, HeadGeometry, HeadShape

_TALLIES = ("frames_total", "frames_used", "dropped_no_pose", "dropped_elements", "dropped_low", "dropped_high")

# Frames that are projected at once.
_PORTION = 4096


class MapGrid(Record, eq=False):
    """Lattice of a map's cells on a plane."""

    plane_from_base: FloatArray
    """(4, 4) array: Cells are centred on whole multiples of their side in this `plane`."""
    cell_mm: float = CELL_MM
    """Side of the square cells."""

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
    faults: Sequence[TaxelFault] = ()
    """Taxels left out of every frame."""
    pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA
    """Frames whose mean lies outside are left out."""
    normalise: str = "mean"
    """``"mean"`` or ``"none"``. A gain a frame needs all frames at once: see `tactile_bayes.mapping.build_map`."""

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
        kept.
        """
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
