"""Settings of a call from its options and its settings file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_bayes.commands.paths import also_read, refuse_same
from tactile_bayes.pipeline.settings import Settings

if TYPE_CHECKING:
    from tactile_bayes.size.site import Repeatability


def settings_of(path: Path | None, **options: Any) -> Settings:
    """Make settings from options and a settings file.

    Raises
    ------
    BadDataError
        Naming the file, the key, its value and what is allowed.
    UsageError
        When the checkpoint that the file names is another file of the call.
    """
    if path is None:
        return Settings(**options)
    from tactile_bayes.files.settings_toml import read_settings

    settings = Settings(**options, **read_settings(path))
    also_read(settings.checkpoint)
    if settings.checkpoint is not None:
        refuse_same([settings.checkpoint], [path])
    return settings


def repeatability_in(path: Path | None) -> Repeatability | None:
    """The repeatability that an option names; None where it names none."""
    if path is None:
        return None
    from tactile_bayes.files.repeatability_json import read_repeatability

    return read_repeatability(path)
