"""Options declared once: type, range, default and meaning stand at a field, and the rest comes from there.

Click options (`commands.options.takes`), keywords and checks of Python, the settings file with its schema, and the
settings of a provenance are made of these records.
"""

from __future__ import annotations

from typing import Annotated, Final

from tactile_bayes.declarations import Meta, Options


class BumpPrior(Options):
    """Proper, weak priors, all of them printed with the estimate."""

    amplitude_sd: Annotated[
        float,
        Meta(gt=0, le=1000, description="Normal about 0, in units of the map's scale (1 for a normalised map)"),
    ] = 2.0
    width_median_mm: Annotated[
        float, Meta(gt=0, le=100, description="Median of the geometric mean of the two widths, log-normal")
    ] = 5.0
    log_width_sd: Annotated[float, Meta(gt=0, le=10, description="SD of its natural log")] = 1.0
    log_ratio_sd: Annotated[
        float, Meta(gt=0, le=5, description="SD of half the log of the axis ratio, along and across the diagonal")
    ] = 0.5
    tilt_sd: Annotated[
        float,
        Meta(
            gt=0,
            le=1000,
            description="SD of the level's slope over half a window, in units of the map's scale; for its odds only",
        ),
    ] = 0.1


PRIORS: Final = BumpPrior.__struct_fields__
