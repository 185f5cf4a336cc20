"""Settings as the sampler takes them, and whether they go together."""

from __future__ import annotations

from typing import Any

from tactile_bayes.declarations import field
from tactile_bayes.errors import UsageError
from tactile_bayes.inference.draws import INDEPENDENT_DRAWS
from tactile_bayes.options import FitSettings
from tactile_bayes.presets import FIT_RADIUS_MM, Background, Noise, Rotation, SceneAsked
from tactile_bayes.size.pooling import SizePriors

DETECTED = 0.95
"""Evidence for a bump against smooth errors, as a probability at even odds, below which there is no estimate."""
ROTATION_ODDS = 3.0  #: Odds above which a rotated ellipse is used instead of one along the head's axes.


class SamplerSettings(FitSettings, kw_only=True):
    """Settings as the sampler takes them: nothing is left open, and some are no user's to set."""

    background: Background = "fixed"
    fit_radius_mm: float = FIT_RADIUS_MM
    noise: Noise = "independent"
    start_width_mm: float | None = None
    """About how wide the bump is, where a fit of the same place has told; None starts from `START_WIDTHS_MM`."""
    size_priors: SizePriors = field(default_factory=SizePriors)
    """Spread between maps and shape of the lump; only a calibration over bodies uses them."""
    store: Any = None  #: `ChainStore` where an ensemble keeps its state between runs, under a noise field.
    draws: int = INDEPENDENT_DRAWS
    """Of ``laplace`` under a noise field; 400 know the ends of an interval to a tenth of an SD."""
    step_up: bool = True
    """Under a noise field: whether the next method is tried where the one asked for fails."""


def check_options(options: SamplerSettings) -> None:
    """Refuse options that contradict each other or do not exist."""
    if not options.correlated:
        asked = {"a scene": options.scene not in ("auto", "none"), "an accuracy in mm": options.accuracy_mm is not None}
        asked |= {"a checkpoint": options.store is not None}
        for name, given in asked.items():
            if given:
                raise UsageError(f'{name} needs correlated errors; give noise = "field" in --settings FILE.toml')
        return
    if options.store is not None and options.method != "ensemble":
        raise UsageError("only the ensemble has checkpoints; give --method ensemble")
    if options.method == "optimise":
        raise UsageError(
            "optimise is the paper's least squares and has no noise field, with which this calibration was learned; "
            "give --method laplace, or a calibration learned by least squares"
        )
    if options.background != "free":
        raise UsageError('noise = "field" needs a free background; give background = "free" in --settings FILE.toml')


def scene_asked(options: SamplerSettings) -> SceneAsked:
    """The requested scene; where none is named, the rotation option decides."""
    by_rotation: dict[Rotation, SceneAsked] = {"on": "rotated", "off": "ellipse", "auto": "auto"}
    turned = by_rotation[options.rotation]
    return turned if options.scene == "auto" else options.scene
