"""Measurements of simulated exams of known lumps, from which a size calibration is learned."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, TactileBayesError
from tactile_bayes.forward.population import BodyPrior
from tactile_bayes.forward.scene import FLAT_MM, Head, Scene
from tactile_bayes.geometry import FloatArray
from tactile_bayes.head_shape import FLAT_RADIUS_MM, HeadShape
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.options import EstimateOptions, FitOptions
from tactile_bayes.presets import DEFAULT_NORMALISE, HEAD_PROFILE
from tactile_bayes.scan import Scan
from tactile_bayes.size.draws import ShapeDraws
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.terms import LOGGED

UNKNOWNS = ("depth_mm", "stiffness_ratio", "seat", "fat_kpa", "gland_ratio", "thickness_mm")
SHAPE_COVARIANCE = ("var_log_a", "cov_log_a_p", "cov_log_a_q", "var_p", "cov_p_q", "var_q")
FIT_RADIUS_MM = 20.0
_DRAWS_SEED = 1
BODY_COLUMNS = tuple(one.name for one in fields(BodyPrior))


def measuring_options() -> EstimateOptions:
    """Fit options for a population's maps: as for a patient's, along the head's axes, by mode and curvature."""
    return EstimateOptions(method="laplace", fit=FitOptions("free", FIT_RADIUS_MM, "off", None, "field"))


@dataclass(frozen=True, slots=True)
class MassRow:
    """One exam of one mass: true properties and measurements; the fields are the table's columns.

    Parameters
    ----------
    body
        Number of the mass: exams of one share it.
    exam
        From 0.
    d_mm, depth_ratio, stiffness_ratio, seat, fat_kpa, gland_ratio, thickness_mm
        What no map says.
    mean_kpa
        Mean pressure of the frames used.
    detected
        Whether a patient's path would give an estimate; if not, what follows is None.
    amplitude, sigma_x_mm, sigma_y_mm
        Medians.
    var_log_a ... var_q
        Posterior covariance of ln a, p and q (p and q: half sum and half difference of the logs of the widths).
    head_profile_x2, head_profile_y2, head_profile_y4
        How pressure was spread over the head where it felt no lump, see `mapping.head_profile`; None where it always
        felt one.
    normalise
        How the map's frames were, see `MapRecipe`.
    head_rows, head_columns, head_pitch_mm, head_radius_mm, head_shoulder_mm, head_rim_mm
        As in `forward.scene.Head`; the radius is None for a flat head.
    """

    body: int
    exam: int
    d_mm: float
    depth_ratio: float
    stiffness_ratio: float
    seat: float
    fat_kpa: float
    gland_ratio: float
    thickness_mm: float
    mean_kpa: float | None = None
    detected: bool = False
    amplitude: float | None = None
    sigma_x_mm: float | None = None
    sigma_y_mm: float | None = None
    var_log_a: float | None = None
    cov_log_a_p: float | None = None
    cov_log_a_q: float | None = None
    var_p: float | None = None
    cov_p_q: float | None = None
    var_q: float | None = None
    head_profile_x2: float | None = None
    head_profile_y2: float | None = None
    head_profile_y4: float | None = None
    normalise: str = "mean"
    head_rows: int | None = None
    head_columns: int | None = None
    head_pitch_mm: float | None = None
    head_radius_mm: float | None = None
    head_shoulder_mm: float | None = None
    head_rim_mm: float | None = None


def measure_mass(
    scenes: Sequence[Scene],
    *,
    body: int,
    scan: Callable[[Scene], Scan],
    normalise: Sequence[str] = (DEFAULT_NORMALISE,),
) -> list[MassRow]:
    """Scan each scene of a mass, map and fit it; returns a row for each scene and normalisation.

    Parameters
    ----------
    scenes
        Exams of one lump in one body, see `forward.population.draw_mass`.
    scan
        Makes the scan of a scene.
    normalise
        As `build_map`'s: a map by each from one scan.
    """
    rows = []
    for i, scene in enumerate(scenes):
        made = scan(scene)
        rows += [measure_exam(scene, made, body=body, exam=i, normalise=one) for one in normalise]
    return rows


def measure_exam(scene: Scene, scan: Scan, *, body: int, exam: int, normalise: str = DEFAULT_NORMALISE) -> MassRow:
    """Row of one exam; the measured columns are empty where no map can be built or no lump is detected."""
    lump, tissue = scene.solid_lumps[0], scene.body
    assert tissue is not None
    row = MassRow(
        body,
        exam,
        lump.d_mm,
        lump.depth_ratio,
        lump.stiffness_ratio,
        lump.seat or 0.0,
        tissue.fat_kpa,
        tissue.gland_ratio,
        tissue.thickness_mm,
        normalise=normalise,
        **head_columns(scene.head),
    )
    try:
        tactile_map = build_map(scan, normalise=normalise)
        quality = tactile_map.quality
        profile: dict[str, Any] = {name: quality.get(name) for name in HEAD_PROFILE}
        row = replace(row, mean_kpa=quality["mean_pressure_kpa"], **profile)
        return replace(row, **_measured(tactile_map))
    except TactileBayesError:
        return row


def _measured(tactile_map: TactileMap) -> dict[str, Any]:
    rng = np.random.default_rng(_DRAWS_SEED)
    found = estimate_map(tactile_map, calibration=None, options=measuring_options(), rng=rng)
    if found.status != "estimate" or found.map_posterior is None:
        return {}
    posterior = found.map_posterior
    draws = ShapeDraws.of(posterior.amplitude, posterior.sigma_x_mm, posterior.sigma_y_mm, posterior.angle_rad)
    shape = np.stack([draws.log_amplitude, draws.log_width, draws.q])
    shape = shape[:, np.isfinite(shape).all(axis=0)]
    mean, covariance = shape.mean(axis=1), np.cov(shape)
    upper = covariance[np.triu_indices(3)]
    return {
        "detected": True,
        "amplitude": float(np.exp(mean[0])),
        "sigma_x_mm": float(np.exp(mean[1] + mean[2])),
        "sigma_y_mm": float(np.exp(mean[1] - mean[2])),
        **{name: float(value) for name, value in zip(SHAPE_COVARIANCE, upper, strict=True)},
    }


def head_columns(head: Head) -> dict[str, Any]:
    """Columns of a table that name its head."""
    found: dict[str, Any] = {f"head_{name}": value for name, value in asdict(head).items()}
    return found | ({"head_radius_mm": None} if head.radius_mm >= FLAT_RADIUS_MM else {})


def table_head(columns: Mapping[str, Sequence[Any]]) -> HeadShape:
    """Head that a table's maps were made with.

    Raises
    ------
    BadDataError
        When rows differ in it.
    """
    names = [f"head_{one.name}" for one in fields(Head)]
    found = set(zip(*(columns[name] for name in names), strict=True))
    if len(found) > 1:
        raise BadDataError("its maps were made with several heads", way_out="learn from the rows of one head")
    rows, wide, pitch, radius, shoulder, rim = found.pop()
    head = Head(rows, wide, pitch, FLAT_MM if radius is None else radius, shoulder, rim)
    Scene(head=head)  # refuses what is no head
    return HeadShape.of(head.surface_mm(), head.pitch_mm, rim_mm=head.rim_mm)


def table_bodies(columns: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Ranges of a table's lumps and bodies, by its columns."""
    return {name: (min(columns[name]), max(columns[name])) for name in BODY_COLUMNS}


def population_table(columns: Mapping[str, Sequence[float | None]]) -> PopulationTable:
    """Detected rows of a table with the fields of `MassRow`, in the form for learning.

    A row without a profile of the head has NaN for it.
    """
    kept = [i for i, found in enumerate(columns["detected"]) if found]

    def column(name: str) -> FloatArray:
        return np.array([columns[name][i] for i in kept], dtype=np.float64)

    covariance = np.empty((len(kept), 3, 3))
    for (i, j), name in zip(zip(*np.triu_indices(3), strict=True), SHAPE_COVARIANCE, strict=True):
        covariance[:, i, j] = covariance[:, j, i] = column(name)
    sigma_x, sigma_y = np.log(column("sigma_x_mm")), np.log(column("sigma_y_mm"))
    varied = {name: column(name) for name in UNKNOWNS if name in columns}
    varied = {"depth_mm": column("depth_ratio") * column("d_mm"), **varied}
    profile = _figures(columns, kept, HEAD_PROFILE)
    boundary = (column("depth_ratio") + column("seat") / 2) * column("d_mm")
    return PopulationTable(
        body=np.array([columns["body"][i] for i in kept]),
        d_mm=column("d_mm"),
        log_amplitude=np.log(column("amplitude")),
        log_width=(sigma_x + sigma_y) / 2,
        half_log_ratio=(sigma_x - sigma_y) / 2,
        covariance=covariance,
        unknowns={name: np.log(varied[name]) if name in LOGGED else varied[name] for name in UNKNOWNS},
        profile=profile,
        log_fat=None if profile is None else np.log(boundary),
    )


def _figures(
    columns: Mapping[str, Sequence[float | None]], kept: Sequence[int], names: Sequence[str]
) -> FloatArray | None:
    """(n, k) named figures of the chosen rows, NaN where a row lacks one of them; None where all rows do."""
    if not all(name in columns for name in names):
        return None
    found = np.array([[columns[name][i] for name in names] for i in kept], dtype=np.float64).reshape(-1, len(names))
    whole = np.isfinite(found).all(axis=1)
    found[~whole] = np.nan
    return found if whole.any() else None
