"""Options of fits and estimates, validated once and used by every step."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tactile_bayes.declarations import Record, field
from tactile_bayes.errors import UsageError, check_choice
from tactile_bayes.inference.draws import INDEPENDENT_DRAWS
from tactile_bayes.options import BumpPrior
from tactile_bayes.presets import METHODS, Background, Method, Noise, Rotation, SceneAsked
from tactile_bayes.size.pooling import SizePriors

if TYPE_CHECKING:
    from tactile_bayes.inference.ensemble import ChainStore

DETECTED = 0.95
"""Evidence for a bump against smooth errors, as a probability at even odds, below which there is no estimate."""
ROTATION_ODDS = 3.0
"""Odds above which a rotated ellipse is used instead of one along the head's axes."""


class FitOptions(Record):
    """How a map is fitted; must agree with the size calibration's recipe."""

    background: Background = "fixed"
    """``"fixed"`` at the level that normalising defines (1 in Eq 7), or ``"free"``. A map whose level is not known can
    only have a free one.
    """
    radius_mm: float = 20.0
    """Cells within this distance of the lump's centre are fitted."""
    rotation: Rotation = "auto"
    """``"auto"`` rotates the ellipse only where the odds exceed `ROTATION_ODDS`; ``"off"`` and ``"on"`` decide
    beforehand.
    """
    centre_mm: tuple[float, float] | None = None
    """Where to look, in `plane`; None takes the highest bump that can be a lump."""
    noise: Noise = "independent"
    """``"independent"``: least squares, the likelihood divided by the inflation of correlated errors. ``"field"``:
    correlated errors in the model; level and tilt are integrated out with them.
    """
    start_width_mm: float | None = None
    """About how wide the bump is, where a fit of the same place has told; None starts from `START_WIDTHS_MM`."""
    field_cosines: int | None = None
    """Of the noise field along each axis: more of them are slower and see finer correlation. None takes as many as the
    bump's width calls for, see `field.cosines_for`.
    """

    @property
    def correlated(self) -> bool:
        """Whether the model has correlated errors; least squares then only finds the place."""
        return self.noise == "field"


class EstimateOptions(Record):
    """Settings of an estimate."""

    method: Method = "importance"
    """One of `presets.METHODS`."""
    fit: FitOptions = field(default_factory=FitOptions)
    """Background, window, rotation, centre, noise."""
    prior: BumpPrior = field(default_factory=BumpPrior)
    """On the bump."""
    max_steps: int | None = None
    """Of the ensemble; None for its default."""
    accuracy_sd: float | None = None
    """Wanted Monte-Carlo error of the ends of 95 % intervals, of sizes and widths alike, in posterior SDs; None for the
    method's default.
    """
    size_priors: SizePriors = field(default_factory=SizePriors)
    """Spread between maps and shape of the lump; only a calibration over bodies uses them."""
    scene: SceneAsked = "auto"
    """One of `presets.SceneAsked`, under a noise field."""
    accuracy_mm: float | None = None
    """The same in mm; the finer of the two holds. Under a noise field."""
    store: ChainStore | None = None
    """Where an ensemble keeps its state between runs, under a noise field."""
    draws: int = INDEPENDENT_DRAWS
    """Of ``laplace`` under a noise field; 400 know the ends of an interval to a tenth of an SD."""
    step_up: bool = True
    """Under a noise field: whether the next method is tried where the one asked for fails."""


def check_options(options: EstimateOptions) -> None:
    """Refuse options that contradict each other or do not exist."""
    check_choice("method", options.method, METHODS)
    if not options.fit.correlated:
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
    if options.fit.background != "free":
        raise UsageError('noise = "field" needs a free background; give background = "free" in --settings FILE.toml')


def scene_asked(options: EstimateOptions) -> SceneAsked:
    """The requested scene; where none is named, the rotation option decides."""
    by_rotation: dict[Rotation, SceneAsked] = {"on": "rotated", "off": "ellipse", "auto": "auto"}
    turned = by_rotation[options.fit.rotation]
    return turned if options.scene == "auto" else options.scene
