r"""What the maps of one body hide at two visits: how far it is the same.

B, what no map shows of a body, is a function of properties that stay (stiffness, moduli) and of some that change as a
lump grows (seat, depth over size). At visits v and w of one body, B over its SD has the correlation

.. math:: \rho_{vw} = (1 - f)\, \exp\Big(-\tfrac12 (g_v - g_w)^2 / \lambda^2\Big)

where g is the log size by the maps. f is the share of B's variance that another posture draws anew though the lump is
the same; the rest of a change in B grows with the square of the growth, as of any smooth function.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True)
class SharedBody:
    """Law of the correlation of B between visits of one body.

    Parameters
    ----------
    redrawn
        f, the share of the variance of B that differs between visits of an unchanged lump, 0 to 1.
    length
        Lambda: a change in ln d after which the rest of the correlation has fallen to exp(-1/2).
    """

    redrawn: float
    length: float

    def __post_init__(self) -> None:
        if not (0.0 <= self.redrawn <= 1.0 and self.length > 0.0):
            raise BadDataError(
                f"redrawn is {self.redrawn:g} and length {self.length:g}", way_out="give 0 to 1, and a length above 0"
            )

    def correlation(self, log_size: FloatArray) -> FloatArray:
        """(v, v) correlation matrix of visits whose maps give these (v,) log sizes."""
        apart = (log_size[:, None] - log_size) / self.length
        shared = (1.0 - self.redrawn) * np.exp(-0.5 * apart**2)
        np.fill_diagonal(shared, 1.0)
        return np.asarray(shared)


SHARED_BODY: Final = SharedBody(0.11, 0.48)
"""Learned from simulated visits, see record 0132: ``python -m benchmarks.visits law``."""
SHARED_WITHOUT_DEPTH: Final = SharedBody(0.19, 0.39)
"""Where maps tell no depth of fat: most of what they hide is that depth, which stays as the lump grows."""
STRANGERS: Final = SharedBody(1.0, 1.0)
"""Nothing shared: each visit's size for itself, as two separate estimates have it."""
