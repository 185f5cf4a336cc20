"""A map that several tests estimate is searched for its lump once."""

from searched_once import searched_once

__all__ = ["searched_once"]
