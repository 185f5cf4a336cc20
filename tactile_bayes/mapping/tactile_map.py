"""The tactile map, with the recipe by which it was built."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import field

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.head_shape import HeadShape
from tactile_bayes.records import dataclass

# A cell with fewer readings than this is flagged: its mean is noisy, and its variance says little.
FEW_READINGS = 10


@dataclass(frozen=True, slots=True)
class MapRecipe:
    """How a map was built; a size calibration fits only maps of its own recipe.

    Parameters
    ----------
    source
        ``"scan"`` or ``"grid"`` (a map imported as it is).
    normalise
        ``"mean"``, ``"gain"`` or ``"none"``.
    cell_mm
        Side of the square cells.
    pressure_window_kpa
        The gate on the frame's mean; None for an imported grid.
    latency_ms
        By how much a pose's stamp is late against the frames.
    flat_field
        Whether the head's own response was taken off.
    registered
        Whether the strokes were shifted onto each other.
    units
        Of an imported grid's values, as the user named them; empty where unknown. A scan's are kPa.
    """

    source: str
    normalise: str
    cell_mm: float
    pressure_window_kpa: tuple[float, float] | None = None
    latency_ms: float = 0.0
    flat_field: bool = False
    registered: bool = False
    units: str = ""

    @property
    def value_unit(self) -> str:
        """Unit of the map's values: ``"1"`` where they were divided by a level, empty where it is unknown."""
        if self.normalise != "none":
            return "1"
        return "kPa" if self.source == "scan" else self.units

    @property
    def value_words(self) -> str:
        """The map's values in a few words, for the label of a colour bar."""
        if self.normalise == "none":
            name = "mean pressure" if self.source == "scan" else "value"
            return f"{name} ({self.value_unit or 'unit unknown'})"
        name = "pressure" if self.source == "scan" else "value"
        return f"{name} / {'mean of its frame' if self.normalise == 'mean' else 'level beside a lump'}"

    @property
    def flat_field_known(self) -> bool | None:
        """`flat_field` of a scan's map; None for an imported grid, where it is unknown."""
        return self.flat_field if self.source == "scan" else None


@dataclass(frozen=True, slots=True, eq=False)
class TactileMap:
    """Mean normalised pressure on the best-fit plane.

    Parameters
    ----------
    mean, variance : (ny, nx) arrays
        Mean and within-cell variance of the readings; NaN where `count` is 0. Without unit after normalising,
        kPa with ``normalise="none"``.
    count : (ny, nx) int64 array
        Readings per cell.
    x_mm, y_mm : (nx,), (ny,) arrays
        Cell centres in `plane`; x runs across the head, y along it.
    recipe
        How the map was built.
    plane_from_base : (4, 4) array or None
        None for an imported grid.
    patient_from_plane : (4, 4) array or None
        None without landmarks.
    background
        Level far from the lump that normalising defines (1 in the paper's Eqs 5 and 7); None when it is not known.
    frame_count
        Frames that went in. Cells share frames, so a map has fewer independent errors than readings.
    quality
        Counts and figures for the report (frames dropped low/high, tilt, rms...).
    masked_taxels
        Taxels that were left out, one line each: ``"row 3 column 7 dead"``.
    head
        Shape of the head that made the scan; None for an imported grid.
    nipple_mm : (3,) array or None
        The nipple in `plane`; None where it was not touched.
    findings
        What speaks against sizes from it.
    """

    mean: FloatArray
    variance: FloatArray
    count: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    x_mm: FloatArray
    y_mm: FloatArray
    recipe: MapRecipe
    plane_from_base: FloatArray | None = None
    patient_from_plane: FloatArray | None = None
    background: float | None = 1.0
    frame_count: int = 0
    quality: Mapping[str, float] = field(default_factory=dict)
    masked_taxels: tuple[str, ...] = ()
    head: HeadShape | None = None
    nipple_mm: FloatArray | None = None
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        shape = (len(self.y_mm), len(self.x_mm))
        for name in ("mean", "variance", "count"):
            if getattr(self, name).shape != shape:
                raise BadDataError(
                    f"{name} has shape {getattr(self, name).shape}", way_out=f"it must be {shape} (ny, nx)"
                )
        if self.count.size and self.count.min() < 0:
            raise BadDataError(f"count holds {self.count.min()}", way_out="counts must not be negative")
        if not self.recipe.cell_mm > 0:
            raise BadDataError(f"cell_mm is {self.recipe.cell_mm}", way_out="it must be positive, in mm")
        for name in ("mean", "variance", "count", "x_mm", "y_mm"):
            view = getattr(self, name).view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)
        infinite = np.isinf(self.mean)
        if infinite.any() and (infinite & (self.count > 0)).any():
            raise BadDataError("mean holds infinite values", way_out="mark cells without data by count 0")

    @property
    def fingerprint(self) -> int:
        """First 64 bits of a hash of the cells and their values, which seed random numbers whatever file the map is in.

        Where the map came from, where it lies in the patient and what the file says of it are no part of it.
        """
        digest = hashlib.sha256(np.array(self.mean.shape, dtype="<i8").tobytes())
        covered = self.covered
        for values in (self.mean, self.variance, self.count):
            # NaN has many bit patterns: cells without data count as one value
            held = np.where(covered & np.isfinite(values), values, 0.0)
            digest.update(np.ascontiguousarray(held, dtype="<f8").tobytes())
        for axis in (self.x_mm, self.y_mm):
            digest.update(np.ascontiguousarray(axis, dtype="<f8").tobytes())
        return int.from_bytes(digest.digest()[:8], "big")

    @property
    def covered(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(ny, nx) True where the map has data."""
        covered: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = (self.count > 0) & np.isfinite(self.mean)
        return covered

    @property
    def counts_known(self) -> bool:
        """Whether `count` is the number of readings per cell: an imported grid without counts has 1 everywhere."""
        return self.recipe.source == "scan" or bool((self.count > 1).any())

    @property
    def few(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(ny, nx) True for cells with data from fewer than `FEW_READINGS` readings; none where counts are unknown."""
        few: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = (self.count > 0) & (self.count < FEW_READINGS)
        if not self.counts_known:
            few = np.zeros_like(few)
        return few
