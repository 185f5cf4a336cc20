"""Options declared once: type, range, default and meaning stand at a field, and the rest comes from there.

Click options (`commands.options.takes`), keywords and checks of Python, the settings file with its schema, and the
settings of a provenance are made of these records.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from tactile_bayes.declarations import Meta, Options
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import CELL_MM, DEFAULT_NORMALISE, PRESSURE_WINDOW_KPA, Normalise


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


class MapOptions(Options):
    """How a map is built of scans."""

    cell_mm: Annotated[float, Meta(ge=0.01, le=50, description="Side of the square cells, mm.")] = CELL_MM
    pressure_window_kpa: Annotated[
        tuple[Annotated[float, Meta(ge=0)], Annotated[float, Meta(ge=0)]],
        Meta(description="Leave out frames whose mean pressure lies outside.", extra={"metavar": "LOW HIGH"}),
    ] = PRESSURE_WINDOW_KPA
    normalise: Annotated[
        Normalise,
        Meta(
            description="gain: estimate one gain per frame; mean: divide each frame by its mean (the paper); none: "
            "keep kPa."
        ),
    ] = DEFAULT_NORMALISE
    latency_ms: Annotated[
        Annotated[float, Meta(ge=-10_000, le=10_000)] | Literal["auto"],
        Meta(
            description="Delay of the tracker's time stamps; auto: estimate it from the scan, or refuse.",
            extra={"metavar": "MS|auto"},
        ),
    ] = 0.0
    plane_radius_mm: Annotated[
        Annotated[float, Meta(gt=0)] | Literal["auto", "all"],
        Meta(
            description="Fit the plane to frames within this distance of the mass; auto: those whose array can "
            "reach it.",
            extra={"metavar": "MM|auto|all"},
        ),
    ] = "all"
    flat_field: Annotated[
        bool, Meta(description="Remove the head's own response, measured on frames without a lump.")
    ] = False
    register_strokes: Annotated[
        bool, Meta(description="Align the strokes with each other, for a lump that moves with the head.")
    ] = False
    every: Annotated[
        int,
        Meta(
            ge=1,
            description="Use one frame of every N: quicker, and noisier; `tradeoff map` measures both.",
            extra={"metavar": "N"},
        ),
    ] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.pressure_window_kpa
        if not low < high:
            raise UsageError(f"pressure_window_kpa is {(low, high)}; give two rising pressures, in kPa")
        if self.normalise != "none" and not low > 0:
            raise UsageError("pressure_window_kpa starts at 0; frames are divided by their mean, give more")
        if self.latency_ms == "auto" and self.register_strokes:
            raise UsageError(
                "a lump that follows the head mimics a latency; with register_strokes give latency_ms a number"
            )
