"""Simulated exams of varied bodies, and the fits of their maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np

from tactile_bayes.declarations import Meta, Record, as_dict, field, names_of, replace
from tactile_bayes.errors import BadDataError, TactileBayesError
from tactile_bayes.forward.scene import FLAT_MM, Background, Head, Noise, Scene, Strokes, Tracker
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.build import build_map
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.presets import DEFAULT_NORMALISE, HEAD_PROFILE
from tactile_bayes.scans import FLAT_RADIUS_MM, HeadShape, Scan
from tactile_bayes.size.draws import ShapeDraws
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.terms import LOGGED

# --- Priors of simulated exams, which vary as bodies and examiners do: the training set of a size calibration.

Range = tuple[float, float]
Diameter = Annotated[float, Meta(gt=0, le=100)]
DepthRatio = Annotated[float, Meta(ge=0.52, le=10)]
Ratio = Annotated[float, Meta(ge=1, le=10_000)]
Seat = Annotated[float, Meta(ge=0, le=2)]
Modulus = Annotated[float, Meta(ge=0.1, le=1000)]
Thickness = Annotated[float, Meta(gt=0, le=200)]
Pressure = Annotated[float, Meta(ge=1, le=30)]
To10 = Annotated[float, Meta(ge=0, le=10)]
Yaw = Annotated[float, Meta(ge=-180, le=180)]
Tilt = Annotated[float, Meta(ge=0, le=30)]
Lines = Annotated[int, Meta(ge=2, le=50)]
Length = Annotated[float, Meta(ge=0.5, le=200)]
Shift = Annotated[float, Meta(ge=-50, le=50)]
Seconds = Annotated[float, Meta(ge=0.1, le=20)]
Share = Annotated[float, Meta(ge=0, le=0.2)]
Latency = Annotated[float, Meta(ge=0, le=200)]

# Half the rate of a real head: twice the frames would halve the readings' noise, which is small beside the rest.
FRAME_RATE_HZ = 100.0


class _Ranges(Record):
    """Fields that are ranges, the low end first."""

    def __post_init__(self) -> None:
        for name in names_of(self):
            low, high = getattr(self, name)
            if low > high:
                fault = f"{name} runs backwards, from {low:g} to {high:g}"
                raise BadDataError(fault, way_out="give the lower end first")


class BodyPrior(_Ranges):
    """Ranges of lumps and bodies, drawn independently; sizes, stiffnesses and moduli on the log scale.

    Lumps lie from just under the skin to where nothing is felt any more; their stiffness goes from that of the softer
    carcinomas under a few per cent of strain (Samani et al. 2007) to rigid, moduli lie about the paper's 5 kPa and 10.
    """

    d_mm: tuple[Diameter, Diameter] = (5.0, 30.0)  #: Diameter of the lump, a ball, mm.
    depth_ratio: tuple[DepthRatio, DepthRatio] = (0.56, 1.8)  #: Depth of its centre over its diameter.
    stiffness_ratio: tuple[Ratio, Ratio] = (6.0, 100.0)  #: Its modulus over that of fat.
    seat: tuple[Seat, Seat] = (0.0, 1.2)
    """Range of its seat: 0 centred on the gland's surface, 1 touching it from above."""
    fat_kpa: tuple[Modulus, Modulus] = (3.5, 7.5)  #: Young's modulus of fat, kPa.
    gland_ratio: tuple[Ratio, Ratio] = (5.0, 16.0)  #: Modulus of gland over that of fat.
    thickness_mm: tuple[Thickness, Thickness] = (40.0, 90.0)
    """Thickness of the breast under the head, mm; more where the lump needs it."""


class ExamPrior(_Ranges):
    """Ranges of an examiner's technique and of the instrument's errors, drawn anew for each scan."""

    mean_kpa: tuple[Pressure, Pressure] = (7.0, 12.0)  #: Mean pressure of a scan, kPa.
    drift_kpa: tuple[To10, To10] = (0.2, 1.5)  #: Amplitude of its drift, kPa; below the lowest mean_kpa.
    yaw_deg: tuple[Yaw, Yaw] = (-30.0, 30.0)  #: Turn of the head about the normal, degrees.
    tilt_deg: tuple[Tilt, Tilt] = (0.5, 4.0)  #: Amplitude of its rocking, degrees.
    wander_mm: tuple[To10, To10] = (0.2, 1.5)  #: Departure from the line, mm.
    lines: tuple[Lines, Lines] = (4, 7)  #: Parallel lines.
    spacing_mm: tuple[Length, Length] = (4.0, 7.0)  #: Distance between them, mm.
    half_length_mm: tuple[Length, Length] = (28.0, 38.0)  #: Reach of a line either side of the middle, mm.
    off_centre_mm: tuple[Shift, Shift] = (-6.0, 6.0)  #: Distance of the strokes' middle from the lump, each way, mm.
    line_s: tuple[Seconds, Seconds] = (1.0, 1.8)  #: Time for a line, s.
    element_kpa: tuple[To10, To10] = (0.02, 0.3)  #: SD of a reading, kPa.
    tracker_mm: tuple[To10, To10] = (0.05, 0.6)  #: SD of the tracker's position, mm.
    tracker_deg: tuple[To10, To10] = (0.02, 0.3)  #: SD of its attitude, degrees.
    gain_share: tuple[Share, Share] = (0.002, 0.02)  #: Error of the array's calibration, as a share of the gain.
    latency_ms: tuple[Latency, Latency] = (0.0, 12.0)  #: By how much the stamp of a pose is late, ms.

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.drift_kpa[1] >= self.mean_kpa[0]:
            fault = f"drift_kpa reaches {self.drift_kpa[1]:g}, and mean_kpa begins at {self.mean_kpa[0]:g}"
            raise BadDataError(fault, way_out="keep the drift below the mean pressure")


class BodiesFile(Record):
    """Bodies and exams of `population --bodies`.

    Each value is a range, low end first; a missing key keeps its default.
    """

    bodies: BodyPrior = field(default_factory=BodyPrior)
    """Lumps and bodies, each property drawn by itself; sizes, stiffnesses and moduli on the log scale."""
    exams: ExamPrior = field(default_factory=ExamPrior)
    """Technique of the examiner and errors of the instrument, drawn anew for each exam."""


def draw_body(prior: BodyPrior, rng: np.random.Generator) -> tuple[SceneBody, SolidLump]:
    """Draw one body and its lump."""
    d = _log_uniform(prior.d_mm, rng)
    ratio, seat = rng.uniform(*prior.depth_ratio), rng.uniform(*prior.seat)
    stiffness = _log_uniform(prior.stiffness_ratio, rng)
    fat_kpa, gland = _log_uniform(prior.fat_kpa, rng), _log_uniform(prior.gland_ratio, rng)
    # at least this thick, for room below the lump and for some gland below the fat
    least = ratio * d + max(0.6, 0.5 * seat + 0.05) * d + 4.0
    thickness = max(rng.uniform(*prior.thickness_mm), least)
    body = SceneBody(fat_kpa=fat_kpa, gland_ratio=gland, thickness_mm=thickness)
    return body, SolidLump(d_mm=d, depth_ratio=ratio, stiffness_ratio=stiffness, seat=seat)


def draw_exam(prior: ExamPrior, rng: np.random.Generator) -> Scene:
    """Draw one examination of a body; the lump lies in the middle, shifted by `off_centre_mm`."""

    def draw(*names: str) -> dict[str, Any]:
        return {name: rng.uniform(*getattr(prior, name)) for name in names}

    lines = int(rng.integers(prior.lines[0], prior.lines[1] + 1))
    return Scene(  # drawn in this order
        background=Background(**draw("mean_kpa", "drift_kpa"), drift_period_s=rng.uniform(1.5, 5.0)),
        strokes=Strokes(lines=lines, **draw("spacing_mm", "half_length_mm", "wander_mm", "tilt_deg", "yaw_deg")),
        noise=Noise(**draw("element_kpa", "tracker_mm", "tracker_deg", "gain_share")),
        tracker=Tracker(**draw("latency_ms")),
        duration_s=lines * rng.uniform(*prior.line_s),
        frame_rate_hz=FRAME_RATE_HZ,
    )


def _log_uniform(ends: Range, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(ends[0]), np.log(ends[1]))))


# --- Measurements of simulated exams of known lumps, from which a size calibration is learned.

UNKNOWNS = ("depth_mm", "stiffness_ratio", "seat", "fat_kpa", "gland_ratio", "thickness_mm")
SHAPE_COVARIANCE = ("var_log_a", "cov_log_a_p", "cov_log_a_q", "var_p", "cov_p_q", "var_q")
_DRAWS_SEED = 1
BODY_COLUMNS = names_of(BodyPrior)


def measuring_options() -> SamplerSettings:
    """Fit options for a population's maps: as for a patient's, with axes along the head's, by mode and curvature."""
    return SamplerSettings(method="laplace", background="free", rotation="off", noise="field")


class ExamRow(Record):
    """One exam of one mass: true properties and measurements; the fields are the table's columns."""

    body: int  #: Number of the mass: exams of one share it.
    exam: int
    d_mm: float
    depth_ratio: float
    stiffness_ratio: float
    seat: float
    fat_kpa: float
    gland_ratio: float
    thickness_mm: float
    mean_kpa: float | None = None  #: Mean pressure of the frames used.
    detected: bool = False  #: True when a patient's path would give an estimate; if not, what follows is None.
    amplitude: float | None = None  #: Median, as those of the widths.
    sigma_x_mm: float | None = None
    sigma_y_mm: float | None = None
    var_log_a: float | None = None
    """Posterior covariance of ln a, p and q (p and q: half sum and half difference of the logs of the widths), to
    `var_q`."""
    cov_log_a_p: float | None = None
    cov_log_a_q: float | None = None
    var_p: float | None = None
    cov_p_q: float | None = None
    var_q: float | None = None
    head_profile_x2: float | None = None
    """How pressure was spread over the head where it felt no lump, see `mapping.profile`; None where it always felt
    one."""
    head_profile_y2: float | None = None
    head_profile_y4: float | None = None
    normalise: str = "mean"  #: How the map's frames were, see `MapRecipe`.
    head_rows: int | None = None  #: These and the next as in `forward.scene.Head`.
    head_columns: int | None = None
    head_pitch_mm: float | None = None
    head_radius_mm: float | None = None  #: None for a flat head.
    head_shoulder_mm: float | None = None
    head_rim_mm: float | None = None


class Population(Record):
    """Population of masses to draw and examine: all that the rows of a table depend on."""

    scans: int  #: Exams of each mass.
    seed: int
    first_centred: int | None = None
    """From this mass on the lumps are centred on the gland's surface, as in the paper; None for no mass."""
    normalise: tuple[str, ...] = (DEFAULT_NORMALISE,)  #: A map by each of these from one scan.
    bodies: BodyPrior = field(default_factory=BodyPrior)
    exams: ExamPrior = field(default_factory=ExamPrior)
    head: Head = field(default_factory=Head)

    def scenes(self, index: int) -> list[Scene]:
        """The exams of one mass."""
        centred = self.first_centred is not None and index >= self.first_centred
        rng = np.random.default_rng([self.seed, index])
        body, lump = draw_body(replace(self.bodies, seat=(0.0, 0.0)) if centred else self.bodies, rng)
        scenes = []
        for number in range(self.scans):
            exam = draw_exam(self.exams, rng)
            x, y = rng.uniform(*self.exams.off_centre_mm, size=2)
            placed = replace(lump, x_mm=float(x), y_mm=float(y))
            seed = int(np.random.SeedSequence([self.seed, index, number]).generate_state(1)[0])
            scenes.append(replace(exam, seed=seed, body=body, solid_lumps=(placed,), head=self.head))
        return scenes

    def rows(self, index: int, scan: Callable[[Scene], Scan] | None = None) -> list[ExamRow]:
        """Scan, map and fit each exam of a mass, a row per normalisation; `scan` simulates by default, with the scene's
        seed."""
        scan = scan or (lambda scene: simulate(scene, rng=np.random.default_rng(scene.seed)).scan)
        scans = [(i, one, scan(one)) for i, one in enumerate(self.scenes(index))]
        return [
            measure_exam(scene, exam_scan, body=index, exam=i, normalise=normalise)
            for i, scene, exam_scan in scans
            for normalise in self.normalise
        ]


def measure_exam(scene: Scene, scan: Scan, *, body: int, exam: int, normalise: str = DEFAULT_NORMALISE) -> ExamRow:
    """Row of one exam; without a map or a detected lump the measured columns are empty."""
    lump, tissue = scene.solid_lumps[0], scene.body
    assert tissue is not None
    truth = as_dict(replace(lump, seat=lump.seat or 0.0)) | as_dict(tissue)
    columns = {name: truth[name] for name in BODY_COLUMNS} | head_columns(scene.head)
    row = ExamRow(body, exam, normalise=normalise, **columns)
    try:
        tactile_map = build_map(scan, normalise=normalise, as_stated=True)
        quality = tactile_map.quality
        profile: dict[str, Any] = {name: quality.get(name) for name in HEAD_PROFILE}
        row = replace(row, mean_kpa=quality["mean_pressure_kpa"], **profile)
        options, rng = measuring_options(), np.random.default_rng(_DRAWS_SEED)
        estimate = estimate_map(tactile_map, calibration=None, options=options, rng=rng)
    except TactileBayesError:
        return row
    if estimate.status != "estimate" or estimate.map_posterior is None:
        return row
    draws = ShapeDraws.of(estimate.map_posterior)
    shape = np.stack([draws.log_amplitude, draws.log_width, draws.q])
    shape = shape[:, np.isfinite(shape).all(axis=0)]
    mean, covariance = shape.mean(axis=1), np.cov(shape)
    upper = covariance[np.triu_indices(3)]
    return replace(
        row,
        detected=True,
        amplitude=float(np.exp(mean[0])),
        sigma_x_mm=float(np.exp(mean[1] + mean[2])),
        sigma_y_mm=float(np.exp(mean[1] - mean[2])),
        **{name: float(value) for name, value in zip(SHAPE_COVARIANCE, upper, strict=True)},
    )


def head_columns(head: Head) -> dict[str, Any]:
    """Columns of a table that describe its head."""
    columns: dict[str, Any] = {f"head_{name}": value for name, value in as_dict(head).items()}
    return columns | ({"head_radius_mm": None} if head.radius_mm >= FLAT_RADIUS_MM else {})


def table_head(columns: Mapping[str, Sequence[Any]]) -> HeadShape:
    """Head of a table's maps; `BadDataError` for several."""
    names = [f"head_{name}" for name in names_of(Head)]
    heads = set(zip(*(columns[name] for name in names), strict=True))
    if len(heads) > 1:
        raise BadDataError("its maps were made with several heads", way_out="learn from the rows of one head")
    rows, wide, pitch, radius, shoulder, rim = heads.pop()
    head = Head(rows, wide, pitch, FLAT_MM if radius is None else radius, shoulder, rim)
    Scene(head=head)  # refuses an impossible head
    return HeadShape.of(head.surface_mm(), head.pitch_mm, rim_mm=head.rim_mm)


def table_bodies(columns: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Ranges of a table's lumps and bodies, by its columns."""
    return {name: (min(columns[name]), max(columns[name])) for name in BODY_COLUMNS}


def population_table(columns: Mapping[str, Sequence[float | None]]) -> PopulationTable:
    """Detected rows of a table with the fields of `ExamRow`, in the form for learning.

    The head profile is NaN in a row without one, and None if no row has one.
    """
    detected = np.flatnonzero(np.array(columns["detected"], dtype=bool))

    def column(name: str) -> FloatArray:
        return np.array(columns[name], dtype=np.float64)[detected]

    covariance = np.empty((len(detected), 3, 3))
    for (i, j), name in zip(zip(*np.triu_indices(3), strict=True), SHAPE_COVARIANCE, strict=True):
        covariance[:, i, j] = covariance[:, j, i] = column(name)
    sigma_x, sigma_y = np.log(column("sigma_x_mm")), np.log(column("sigma_y_mm"))
    varied = {name: column(name) for name in UNKNOWNS if name in columns}
    varied = {"depth_mm": column("depth_ratio") * column("d_mm"), **varied}
    known_profile = None
    if all(name in columns for name in HEAD_PROFILE):
        profile = np.stack([column(name) for name in HEAD_PROFILE], axis=1)
        complete = np.isfinite(profile).all(axis=1)
        profile[~complete] = np.nan
        known_profile = profile if complete.any() else None
    boundary = (column("depth_ratio") + column("seat") / 2) * column("d_mm")
    return PopulationTable(
        body=np.array(columns["body"])[detected],
        d_mm=column("d_mm"),
        log_amplitude=np.log(column("amplitude")),
        log_width=(sigma_x + sigma_y) / 2,
        half_log_ratio=(sigma_x - sigma_y) / 2,
        covariance=covariance,
        unknowns={name: np.log(varied[name]) if name in LOGGED else varied[name] for name in UNKNOWNS},
        profile=known_profile,
        log_fat=None if known_profile is None else np.log(boundary),
    )
