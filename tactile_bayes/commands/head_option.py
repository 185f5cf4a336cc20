"""`--head`: where the shoulders of a simulated head lie."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from tactile_bayes.presets import HEADS


def head_option(default: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make the option; its help ends with a sentence about the default."""
    return click.option(
        "--head",
        type=click.Choice(HEADS),
        help="Where the head's rounded shoulders lie: cut into the sensing width, or around it, where they press and "
        f"sense nothing. {default}",
    )
