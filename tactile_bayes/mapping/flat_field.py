"""Response of each taxel to an even pressure, from frames without a lump."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.frames import BoolArray, SelectedFrames
from tactile_bayes.mapping.readout import Readout
from tactile_bayes.scan import Scan

# Frames that are looked at, spread evenly over the scan.
MOST_FRAMES = 4096
# A frame is called lump-free when its departure from the head's usual profile is within this factor of the calmest
# tenth's, and there must be this many of them.
CALM_FACTOR = 1.1
LEAST_FRAMES = 50


@dataclass(frozen=True, slots=True, eq=False)
class FlatField:
    """Response of each taxel relative to the array's mean.

    Parameters
    ----------
    response : (rows, columns) array
        1 where the taxel reads as much as its frame's mean; 1 for taxels left out.
    frames
        Lump-free frames it was taken from.
    """

    response: FloatArray
    frames: int

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
    """Estimate the taxels' response over the lump-free frames of a scan.

    Raises
    ------
    BadDataError
        When too few frames look alike to be called lump-free.

    Notes
    -----
    The usual profile of the head is each taxel's median over frames, which a lump under a minority of them does not
    move. Frames that depart from it no more than the calmest ones are lump-free; their mean is the response. A lump
    under most frames would be taken for the head's own profile and be flattened away.
    """
    scan, good = selection.scan, selection.good_taxels
    frames = np.flatnonzero(selection.used)
    frames = frames[:: max(1, len(frames) // MOST_FRAMES)][:MOST_FRAMES]
    readout = Readout.of(scan.element_calibration, good)
    pressure, valid = readout.pressure_kpa(readout.counts(scan.frames.counts[frames]))
    ratio = pressure / selection.level_kpa[frames, None]
    calm = _calm(ratio if valid is None else np.where(valid, ratio, 1.0))
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


def _calm(ratio: FloatArray) -> BoolArray:
    """(f,) True where the departure from the median profile is at most `CALM_FACTOR` times its quantile 0.1."""
    departure = np.sqrt(np.square(ratio - np.median(ratio, axis=0)).mean(axis=1))
    calm: BoolArray = departure <= CALM_FACTOR * float(np.quantile(departure, 0.1))
    return calm
