"""Truth of a simulated scan of tissue."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.tissue import SceneBody, SolidLump, fat_thickness


def tissue_truth(scene: Scene) -> dict[str, Any]:
    """The body and its lumps as plain data; the balls of a rib do not count as lumps."""
    body = scene.body or SceneBody()
    fat = fat_thickness(body, scene.solid_lumps)
    return {
        "lumps": [_lump_truth(lump, body, fat) for lump in scene.solid_lumps],
        "ribs": [asdict(rib) | {"ball_x_mm": [ball.x_mm for ball in rib.balls()]} for rib in scene.ribs],
        "body": asdict(body) | {"fat_mm": fat},
        "background": asdict(scene.background),
    }


def refuse_bumps(scene: Scene, model: str) -> None:
    """Raise BadDataError where a scene gives bumps to a `model` that needs tissue."""
    if scene.lumps:
        raise BadDataError(
            "lump[0] gives no depth_ratio",
            way_out=f"the {model} model needs d_mm and depth_ratio; or use --fidelity empirical-gaussian",
        )


def _lump_truth(lump: SolidLump, body: SceneBody, fat_mm: float) -> dict[str, Any]:
    seat = (fat_mm - lump.depth_mm) / (lump.vertical_mm / 2)
    return asdict(lump) | {
        "height_mm": lump.vertical_mm,
        "seat": seat,
        "depth_mm": lump.depth_mm,
        "lump_kpa": lump.stiffness_ratio * body.fat_kpa,
    }
