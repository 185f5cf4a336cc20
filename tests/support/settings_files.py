"""Settings files for `estimate --settings`."""

from __future__ import annotations

import json
from pathlib import Path


def settings(folder: Path, **keys: object) -> tuple[str, str]:
    """The words that give these settings; the file is written into `folder`."""
    path = folder / f"settings-{abs(hash(str(keys)))}.toml"
    path.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in keys.items()))
    return "--settings", path.name
