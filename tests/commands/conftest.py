"""A map that several tests estimate is estimated once, from few draws, and a trial's pictures are drawn once."""

from drawn_once import drawn_once
from few_draws import few_draws
from searched_once import searched_once

__all__ = ["drawn_once", "few_draws", "searched_once"]
