"""A map that several tests estimate is estimated once, from few draws."""

from few_draws import few_draws
from searched_once import searched_once

__all__ = ["few_draws", "searched_once"]
