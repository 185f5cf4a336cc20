"""Tables 1 and 2 of the paper, computed again beside the measured ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.plane import LineFrames, SurfaceCompliance, TactileLine, build_line, press
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM, SHOULDERS_INSIDE, SHOULDERS_OUTSIDE
from tactile_bayes.studies.paper import HARD_RATIO, LineFit, StudySettings, fit_line

# --- Tables 1 and 2 of the paper and the phantoms of its section 2.3: the empirical model against the elastic one.
#
# The paper prints a mean squared difference without saying of what. Here it is
#
# .. math:: \mathrm{MSD}(u, v) = \sum_i (u_i - v_i)^2 / \sum_i v_i^2
#
# with v the elastic model, and beside it the same relative to what the lump adds, :math:`\sum_i (v_i - 1)^2`, for
# maps. The first hides a bump under the background of 1 (decision record 0007); the second does not.

TABLE_DIAMETERS_MM = (5.0, 10.0, 15.0, 20.0, 25.0)
TABLE_DEPTH_RATIOS = (0.6, 1.8)
PRINTED_FRAMES = {0.6: (4.1, 4.3, 4.1, 4.1, 4.2), 1.8: (4.1, 4.2, 4.2, 4.0, 4.1)}
"""Table 1 in percent, by h/d, over the diameters."""
PRINTED_MAPS = {0.6: (2.4, 2.7, 2.5, 2.3, 2.2), 1.8: (2.3, 2.5, 2.4, 2.5, 2.6)}  #: Table 2 in percent.
DEFINITION = (
    "MSD = sum of squared differences over the sum of squares of the elastic model; the paper does not define its own. "
    "Strict: the same over the sum of squares of (map - 1), what the lump adds."
)
OTHER_DEFINITIONS: dict[str, Callable[[FloatArray, FloatArray], float]] = {
    "root of the same": lambda u, v: float(np.sqrt(np.sum((u - v) ** 2) / np.sum(v**2))),
    "mean square over the largest's": lambda u, v: float(np.mean((u - v) ** 2) / v.max() ** 2),
    "root mean square over the largest": lambda u, v: float(np.sqrt(np.mean((u - v) ** 2)) / v.max()),
    "mean absolute over the mean": lambda u, v: float(np.mean(np.abs(u - v)) / np.mean(v)),
    "over the squares about the mean": lambda u, v: float(np.sum((u - v) ** 2) / np.sum((v - v.mean()) ** 2)),
}
"""Other meanings of a mean squared difference: tried because the printed tables are not met."""
PHANTOMS = {
    "phantom 12.5 mm": (12.5, 0.825),
    "phantom 15.5 mm": (15.5, 1.0),
    "phantom 15.5 mm deep": (15.5, 1.4),
    "phantom 18.75 mm": (18.75, 1.2),
}
"""The silicone models of section 2.3: diameter in mm and h/d, with a rigid lump."""
TRIED_HEADS = tuple(
    Head(radius_mm=radius, shoulder_mm=shoulder, shoulders=kind)
    for radius in (13.0, 16.0, 20.0, 25.0, 35.0, 70.0)
    for kind, shoulder in ((SHOULDERS_INSIDE, 3.0), (SHOULDERS_OUTSIDE, 3.0), (SHOULDERS_OUTSIDE, 15.0))
    if shoulder < radius
)
"""Heads that the tables are computed for with ``tables --heads``."""
NEAREST_HEADS = {
    0.0: Head(radius_mm=13.0, shoulder_mm=3.0, shoulders=SHOULDERS_INSIDE),
    1.0: Head(radius_mm=70.0, shoulder_mm=3.0, shoulders=SHOULDERS_OUTSIDE),
}
"""By seat: of `TRIED_HEADS` the one whose tables lie nearest to the printed ones (`table_distance`; record 0096)."""


class Scene(Record):
    """A lump for which both models are compared."""

    name: str  #: For people.
    d_mm: float
    depth_ratio: float
    seat: float
    """`d_mm`, `depth_ratio`, `seat`: As in `body.Body`."""
    stiffness_ratio: float = HARD_RATIO  #: E2/E1.


class Curves(Record, eq=False):
    """Frames and maps of both models for one scene."""

    elastic: LineFrames
    empirical: LineFrames
    """`elastic`, `empirical`: Frames at the same positions."""
    elastic_map: TactileLine
    empirical_map: TactileLine
    """`elastic_map`, `empirical_map`: What they average to."""


class Agreement(Record):
    """How far the empirical model is from the elastic one; differences as shares, not percent."""

    scene: Scene  #: The lump compared.
    centred_frame: float
    all_frames: float
    map: float
    map_strict: float
    """`centred_frame`, `all_frames`, `map`, `map_strict`: Mean squared differences: of the frame centred on the lump
    (Table 1), of all frames of the map, of the map within the fit's radius (Table 2), and of the map relative to map -
    1."""
    elastic: LineFit
    empirical: LineFit
    """`elastic`, `empirical`: Eq 5 fitted to both maps."""
    normalised_frame: float  #: As `centred_frame`, of frames divided by their means.
    others: tuple[tuple[float, float, float], ...]
    """By each of `OTHER_DEFINITIONS`: of the frame centred on the lump, of the same divided by its mean, of the map."""


def table_scenes(seat: float) -> list[Scene]:
    """The ten cases of Tables 1 and 2, row by row."""
    return [Scene(f"d {d:g} mm, h/d {h:g}", d, h, seat) for h in TABLE_DEPTH_RATIOS for d in TABLE_DIAMETERS_MM]


def phantom_scenes(seat: float) -> list[Scene]:
    """The four phantoms of section 2.3."""
    return [Scene(name, d, h, seat) for name, (d, h) in PHANTOMS.items()]


def scene_curves(scene: Scene, settings: StudySettings, *, surface: SurfaceCompliance | None = None) -> Curves:
    """Frames and maps of both models; the empirical one is fitted to what the taxels see far from and over the lump.

    `surface` is the scene's body condensed onto its skin, where it is at hand.
    """
    if surface is None:
        surface = settings.surface(settings.body(scene.d_mm, scene.depth_ratio, seat=scene.seat))
    elastic = settings.frames(surface, scene.stiffness_ratio)
    model = settings.empirical(scene.d_mm, surface.body.layers, elastic)
    empirical = model.frames(elastic.x_c_mm, elastic.s_mm)
    return Curves(elastic, empirical, build_line(elastic), build_line(empirical))


def compare(scene: Scene, *, settings: StudySettings, surface: SurfaceCompliance | None = None) -> Agreement:
    """One scene's figures; `surface` as in `scene_curves`."""
    curves = scene_curves(scene, settings, surface=surface)
    inside = np.abs(curves.elastic_map.x_mm) <= settings.fit_radius_mm
    ours, theirs = curves.empirical_map.mean[inside], curves.elastic_map.mean[inside]
    fitted, seen = curves.empirical.as_taxels(HEAD_PITCH_MM), curves.elastic.as_taxels(HEAD_PITCH_MM)
    frames = fitted.at(0.0), seen.at(0.0)
    shares = frames[0] / frames[0].mean(), frames[1] / frames[1].mean()
    return Agreement(
        scene,
        mean_squared_difference(*frames),
        mean_squared_difference(fitted.pressure_kpa, seen.pressure_kpa),
        mean_squared_difference(ours, theirs),
        float(np.sum((ours - theirs) ** 2) / np.sum((theirs - 1.0) ** 2)),
        fit_line(curves.elastic_map, settings.fit_radius_mm),
        fit_line(curves.empirical_map, settings.fit_radius_mm),
        mean_squared_difference(*shares),
        tuple((by(*frames), by(*shares), by(ours, theirs)) for by in OTHER_DEFINITIONS.values()),
    )


def compare_heads(scene: Scene, *, settings: StudySettings, heads: Sequence[Head]) -> list[Agreement]:
    """One scene's figures under each of several heads; the body is condensed once."""
    widest = max(heads, key=lambda head: head.half_face_mm)
    body = settings.body(scene.d_mm, scene.depth_ratio, seat=scene.seat)
    surface = replace(settings, head=widest).surface(body)
    return [compare(scene, settings=replace(settings, head=head), surface=surface) for head in heads]


def table_distance(found: Sequence[Agreement]) -> float:
    """Root mean square difference from the printed cells of Tables 1 and 2, in percentage points."""
    gaps = []
    for one in found:
        column = TABLE_DIAMETERS_MM.index(one.scene.d_mm)
        gaps.append(100 * one.centred_frame - PRINTED_FRAMES[one.scene.depth_ratio][column])
        gaps.append(100 * one.map - PRINTED_MAPS[one.scene.depth_ratio][column])
    return float(np.sqrt(np.mean(np.square(gaps))))


def mean_squared_difference(values: FloatArray, reference: FloatArray) -> float:
    """Sum of squared differences over the reference's sum of squares."""
    return float(np.sum((values - reference) ** 2) / np.sum(reference**2))


# --- Frames measured along a head's centre line beside both models of the same lump (Fig 6a of the paper).

LEAST_TAXELS = 4


class MeasuredFrame(Record, eq=False):
    """One frame along the centre line of the head."""

    x_c_mm: float  #: Where the head's centre stands, from the lump's axis.
    s_mm: FloatArray  #: (n,) array: Taxel positions from the head's centre.
    pressure_kpa: FloatArray  #: (n,) array: What the taxels read.

    def __post_init__(self) -> None:
        if len(self.s_mm) < LEAST_TAXELS or not self.pressure_kpa.mean() > 0:
            raise BadDataError(
                f"the frame at x_c_mm {self.x_c_mm:g} has {len(self.s_mm)} taxels with a mean of "
                f"{self.pressure_kpa.mean():.3g} kPa",
                way_out=f"give at least {LEAST_TAXELS} taxels, some of them above 0 kPa",
            )


class FrameAgreement(Record, eq=False):
    """A measured frame and both models at its place and mean pressure."""

    measured: MeasuredFrame  #: As given.
    elastic_kpa: FloatArray
    empirical_kpa: FloatArray
    """`elastic_kpa`, `empirical_kpa` (n,) arrays: The models at the same taxels."""

    @property
    def elastic_difference(self) -> float:
        """Mean squared difference from the elastic model, as a share of the model's sum of squares."""
        return mean_squared_difference(self.measured.pressure_kpa, self.elastic_kpa)

    @property
    def empirical_difference(self) -> float:
        """The same from the empirical model."""
        return mean_squared_difference(self.measured.pressure_kpa, self.empirical_kpa)


def compare_frames(
    frames: Sequence[MeasuredFrame], *, d_mm: float, depth_ratio: float, seat: float, settings: StudySettings
) -> list[FrameAgreement]:
    """Both models of a hard lump at the places and mean pressures of measured frames.

    The empirical model is fitted at the settings' mean pressure and scaled with the frame's. A taxel outside the head,
    or a head beyond the study's positions, is an error.
    """
    half, most = settings.head.half_width_mm, max(abs(end) for end in settings.positions_mm[:2])
    for frame in frames:
        if np.abs(frame.s_mm).max() > half or abs(frame.x_c_mm) > most:
            raise BadDataError(
                f"the frame at x_c_mm {frame.x_c_mm:g} has a taxel at s_mm {np.abs(frame.s_mm).max():g}",
                way_out=f"s_mm must lie within {half:g} mm and x_c_mm within {most:g} mm",
            )
    surface = settings.surface(settings.body(d_mm, depth_ratio, seat=seat))
    head, nominal = settings.head, settings.mean_kpa
    model = settings.empirical(d_mm, surface.body.layers, settings.over(surface))
    places = np.array([frame.x_c_mm for frame in frames])
    means = np.array([frame.pressure_kpa.mean() for frame in frames])
    solved = press(surface, HARD_RATIO, places, head=head, mean_kpa=means).as_taxels(HEAD_PITCH_MM)
    found = []
    for frame, elastic, mean in zip(frames, solved.pressure_kpa, means, strict=True):
        empirical = mean / nominal * model.surface_pressure(frame.s_mm, np.full(len(frame.s_mm), frame.x_c_mm))
        found.append(FrameAgreement(frame, np.interp(frame.s_mm, solved.s_mm, elastic), empirical))
    return found
