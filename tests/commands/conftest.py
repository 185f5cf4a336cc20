"""A map that several tests estimate is estimated once, and a trial's pictures are drawn once."""

from drawn_once import drawn_once
from searched_once import searched_once

__all__ = ["drawn_once", "searched_once"]
