"""The fit problem that all scenes of one window share: cells, prior and bounds."""

from __future__ import annotations

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.window import Window
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.white.fit import WIDEST_IN_RADII
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A window with its cells, and the assumptions about a bump in it.

    Parameters
    ----------
    window
        The cells; scenes share one, and with it the noise fields.
    prior
        On widths and amplitudes.
    radius_mm
        Of the window; bounds the centre about the window's middle.
    amplitude_scale
        Unit of the amplitudes' prior, see `cells.value_scale`.
    departure : (k, n) array
        Further fixed columns, see `correlated.peakedness`; None for none.
    """

    window: Window
    prior: BumpPrior
    radius_mm: float
    amplitude_scale: float = 1.0
    departure: FloatArray | None = None

    @property
    def widest_mm(self) -> float:
        """Upper bound of the widths."""
        return WIDEST_IN_RADII * self.radius_mm
