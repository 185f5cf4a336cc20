"""Simulation of a scan with known truth by one of four forward models: bumps, Eqs 1 to 4, plane strain and solid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record, as_dict, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward import mesh, plane
from tactile_bayes.forward.axisymmetric import CondensedLump, condense_lump, skin_spline, taxel_compliance
from tactile_bayes.forward.contact import Contact, ContactStiffness, solve_contact
from tactile_bayes.forward.scene import (
    Head,
    HeadSection,
    Scene,
    SimulatedScan,
    frame_times,
    head_poses,
    level_kpa,
    normalised_pressure,
    record,
    tissue_truth,
)
from tactile_bayes.forward.tissue import MOST_SEAT, Body, Layers, SolidLump
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM, SHOULDERS_INSIDE, SHOULDERS_OUTSIDE
from tactile_bayes.progress import Progress, no_progress

FIDELITIES: Final = ("empirical-gaussian", "empirical", "plane-strain", "solid")
"""Formula of Gaussian bumps; and for lumps of tissue Eqs 1 to 4, a body in two dimensions, and one in three."""


def simulate(
    scene: Scene,
    *,
    rng: np.random.Generator,
    fidelity: str | None = None,
    head: str | None = None,
    progress: Progress = no_progress,
) -> SimulatedScan:
    """Simulated scan of a scene: frames at ``k / frame_rate_hz``, poses at ``k / pose_rate_hz`` stamped late.

    The scene's seed is not used; `rng` is split into independent streams, so that a longer scan of the same seed keeps
    its gains and calibration. `fidelity` is one of `FIDELITIES`, by default the one the scene is written for. `head`,
    one of `presets.HEADS`, places the shoulders of the scene's head, which by default are as in the scene for solid and
    inside the array in two dimensions. `progress` is called with frames done and frames in all, but not for bumps.
    """
    model, scene = _checked(scene, fidelity, head)
    if model == "empirical-gaussian":
        if head is not None:
            raise BadDataError(
                "--head is given for the empirical-gaussian model, whose bumps do not depend on the head's shoulders",
                way_out="leave --head out, or choose another --fidelity",
            )

        def bumps(time_s: FloatArray) -> FloatArray:
            poses, level = head_poses(scene, time_s), level_kpa(scene.background, time_s)
            return _gaussian_frames(scene, *poses, level, share_load=scene.background.load_sharing)

        lumps, background = [as_dict(lump) for lump in scene.lumps], as_dict(scene.background)
        truth = {"model": "gaussian", "lumps": lumps, "background": background}
        return record(scene, pressure=bumps, truth=truth, rng=rng)
    time_s = frame_times(scene)
    poses, level = head_poses(scene, time_s), level_kpa(scene.background, time_s)
    if model == "solid":
        description = {"model": model, "head": scene.head.shoulders}
        frames, depth_mm = frames_at_poses(scene, *poses, mean_kpa=level, progress=progress)
    else:
        description = {"model": model, "shape": _SHAPE, "head": head or SHOULDERS_INSIDE}
        section = PlaneSection.of(scene, model, shoulders=head or SHOULDERS_INSIDE)
        frames = section.frames(*poses, level, reach_mm=_stroke_reach_mm(section), progress=progress)
    return record(
        scene,
        pressure=lambda at_s: frames[np.searchsorted(time_s, at_s)],
        depth=(lambda at_s: np.interp(at_s, time_s, depth_mm)) if model == "solid" else None,
        truth=description | tissue_truth(scene),
        rng=rng,
    )


def _checked(scene: Scene, fidelity: str | None, head: str | None) -> tuple[str, Scene]:
    """Model of a scene, and the scene with the shoulders of its head placed; `BadDataError` where they do not fit.

    In two dimensions shoulders inside the array are the section's default, and the scan has the scene's own head.
    """
    model = scene.fidelity if fidelity is None else fidelity
    if model not in FIDELITIES:
        raise BadDataError(f"fidelity is {model!r}", way_out=f"choose {', '.join(FIDELITIES)}")
    if model == "empirical-gaussian":
        if scene.solid_lumps or scene.ribs:
            raise BadDataError(
                "lump[0] gives depth_ratio and no amplitude" if scene.solid_lumps else "rib[0] is of tissue",
                way_out="use --fidelity solid, or describe the bump with amplitude, sigma_x_mm and sigma_y_mm",
            )
        return model, scene
    if scene.lumps:
        raise BadDataError(
            "lump[0] gives no depth_ratio",
            way_out=f"the {model} model needs d_mm and depth_ratio; or use --fidelity empirical-gaussian",
        )
    if head is not None and (model == "solid" or head != SHOULDERS_INSIDE):
        scene = replace(scene, head=scene.head.with_shoulders(head))
    return model, scene


def felt_at_poses(
    scene: Scene,
    rotation: FloatArray,
    origin_mm: FloatArray,
    *,
    mean_kpa: FloatArray,
    fidelity: str | None = None,
    head: str | None = None,
    progress: Progress = no_progress,
) -> FloatArray:
    """(n, rows, columns) pressures in kPa at n poses of the head and mean pressures, without noise.

    Tissue and head of the scene are used; strokes, noise and tracker are not. Rotations (n, 3, 3) and origins (n, 3) of
    the head's face lead from `scanhead` to the scene's `plane`; the rest is as in `simulate`. In two dimensions tilts
    and depths are not used, and a pose beyond the skin that is solved for is a `BadDataError`.
    """
    model, scene = _checked(scene, fidelity, head)
    if model == "empirical-gaussian":
        return _gaussian_frames(scene, rotation, origin_mm, mean_kpa, share_load=True)
    if model == "solid":
        return frames_at_poses(scene, rotation, origin_mm, mean_kpa=mean_kpa, progress=progress)[0]
    section = PlaneSection.of(scene, model, shoulders=head or SHOULDERS_INSIDE)
    place, most = section.places_mm(rotation, origin_mm), section.most_reach_mm
    reach = float(np.abs(place).max()) + section.half_face_mm + 1.0
    if reach > most:
        what = f"the head gets {reach:.4g} mm from the lump"
        raise BadDataError(what, way_out=f"the {model} model reaches {most:g} mm")
    return section.frames(rotation, origin_mm, mean_kpa, reach_mm=reach, progress=progress)


def _gaussian_frames(
    scene: Scene, rotation: FloatArray, origin_mm: FloatArray, level: FloatArray, *, share_load: bool
) -> FloatArray:
    """(n, rows, columns) kPa of bumps; with `share_load` the frame's mean is the level, without it the background."""
    surface = scene.head.surface_mm()
    # of the plane only x and y matter: the first two rows of each pose
    xy = np.einsum("nij,rcj->nirc", rotation[:, :2], surface) + origin_mm[:, :2, None, None]
    shape = normalised_pressure(scene.lumps, xy[:, 0], xy[:, 1])
    if share_load:
        shape /= shape.mean(axis=(1, 2), keepdims=True)
    return np.asarray(level[:, None, None] * shape)


# --- Scans in two dimensions of one lump of tissue: a cylinder along y under the head, solved or by Eqs 1 to 4.
#
# Nothing changes along y: each column of taxels reads the profile of a head at that column's place across the lump.
# Tilts are in the poses, not in the pressures, and the head's depth is not computed. The plane-strain model solves the
# head's contact at each place and force; the empirical one takes Eqs 1 to 4 as printed, fitted to two frames of the
# plane-strain model at the nominal pressure, and scaled with the pressure.

Profiles = Callable[[FloatArray, FloatArray], FloatArray]
"""(m, rows) pressures in kPa across a head at (m,) places from the lump's axis, with (m,) mean pressures in kPa."""

_CELLS_PER_TAXEL = 6  #: Cells of the contact.
_SPACING_MM = 0.25  #: Largest distance between the places of neighbouring profiles of one head.
_FRAMES_AT_ONCE = 100
_SHAPE = "a cylinder along y: each frame's profile across the head is repeated along it"


def _stroke_reach_mm(section: PlaneSection) -> float:
    """Largest distance of the head's edges from the lump's axis; `BadDataError` beyond the mesh."""
    scene, half_mm, most = section.scene, section.half_face_mm, section.most_reach_mm
    stroke = scene.strokes.half_length_mm + scene.strokes.wander_mm + scene.head.columns * scene.head.pitch_mm / 2
    reach = stroke + abs(section.x_mm) + half_mm + 1.0
    if reach > most:
        raise BadDataError(
            f"the head gets {reach:.4g} mm from the lump (strokes.half_length_mm {scene.strokes.half_length_mm:g}, "
            f"a head {2 * half_mm:g} mm wide)",
            way_out=f"the mesh reaches {most:g} mm: shorten the strokes or narrow the head",
        )
    return reach


class PlaneSection(Record, eq=False):
    """A scene's section across the lump."""

    scene: Scene
    fidelity: str  #: ``"plane-strain"``, which solves the contact, or ``"empirical"``, Eqs 1 to 4.
    head: HeadSection  #: With shoulders of the scene's `shoulder_mm`, or its `rim_mm` where that is 0.
    lump: tuple[Body, float] | None  #: Body with a lump, and the lump's stiffness ratio; None without a lump.

    @classmethod
    def of(cls, scene: Scene, fidelity: str, *, shoulders: str = SHOULDERS_INSIDE) -> PlaneSection:
        """Section of a scene; `BadDataError` for what two dimensions cannot represent."""
        many = "a rib" if scene.ribs else f"{len(scene.solid_lumps)} lumps" if len(scene.solid_lumps) > 1 else ""
        if many:
            way_out = f"the {fidelity} model has one lump and no rib; use --fidelity solid"
            raise BadDataError(f"the scene has {many}", way_out=way_out)
        lump = _cylinder(scene.solid_lumps[0], scene.layers, fidelity) if scene.solid_lumps else None
        width = scene.head.rows * scene.head.pitch_mm
        if shoulders == SHOULDERS_INSIDE and scene.head.rim_mm > width / 2:
            raise BadDataError(
                f"head.rim_mm is {scene.head.rim_mm:g}",
                way_out=f"in two dimensions the rim is cut into the array: give at most {width / 2:g} mm",
            )
        return cls(scene, fidelity, scene.head.section(shoulders), lump)

    @property
    def x_mm(self) -> float:
        """Place of the lump's axis."""
        return self.scene.solid_lumps[0].x_mm if self.scene.solid_lumps else 0.0

    @property
    def cell_mm(self) -> float:
        """Width of the contact's cells."""
        return self.scene.head.pitch_mm / _CELLS_PER_TAXEL

    @property
    def half_face_mm(self) -> float:
        """Half the width of the face, in whole cells."""
        return 0.5 * self.cell_mm * len(self.head.sensing_cells(self.cell_mm))

    @property
    def most_reach_mm(self) -> float:
        """Largest distance of the head's edges from the lump's axis that the mesh allows."""
        return mesh.REACH_MM + self.scene.layers.thickness_mm

    def places_mm(self, rotation: FloatArray, origin_mm: FloatArray) -> FloatArray:
        """(n, columns) place of each column of taxels at (n,) poses, from the lump's axis."""
        head = self.scene.head
        along = (np.arange(head.columns) - (head.columns - 1) / 2) * head.pitch_mm
        return np.asarray(origin_mm[:, :1] + rotation[:, 0, 1, None] * along - self.x_mm)

    def frames(
        self,
        rotation: FloatArray,
        origin_mm: FloatArray,
        level_kpa: FloatArray,
        *,
        reach_mm: float,
        progress: Progress = no_progress,
    ) -> FloatArray:
        """(n, rows, columns) pressures in kPa at (n,) poses and mean pressures, without noise.

        A head turned about the normal has its columns at different places across the lump, its edges within `reach_mm`;
        profiles are computed no more than 0.25 mm apart and interpolated between.
        """
        profiles, place = self._profiles(reach_mm), self.places_mm(rotation, origin_mm)
        pressure = np.zeros((len(level_kpa), self.scene.head.rows, self.scene.head.columns))
        pressed = np.flatnonzero(level_kpa > 0)
        for chunk in np.array_split(pressed, len(pressed) // _FRAMES_AT_ONCE or 1) if len(pressed) else ():
            ends = [(float(place[i].min()), float(place[i].max())) for i in chunk]
            across = [np.linspace(low, high, 1 + int(np.ceil((high - low) / _SPACING_MM - 1e-9))) for low, high in ends]
            counts = [len(x) for x in across]
            values = profiles(np.concatenate(across), np.repeat(level_kpa[chunk], counts))
            for i, x, profile in zip(chunk, across, np.split(values, np.cumsum(counts)[:-1]), strict=True):
                pressure[i] = [np.interp(place[i], x, taxel) for taxel in profile.T]
            progress(int(chunk[-1]) + 1, len(level_kpa))
        return pressure

    def _profiles(self, reach_mm: float) -> Profiles:
        """Profiles at places whose edges lie within `reach_mm` of the lump; without one they are alike everywhere."""
        if self.lump is None:
            return lambda _, mean_kpa: self._far(mean_kpa).pressure_kpa
        body, ratio = self.lump
        surface = plane.condense(body, reach_mm=reach_mm, cell_mm=self.cell_mm)
        if self.fidelity == "plane-strain":
            return lambda x_mm, mean_kpa: self._over(surface, ratio, x_mm, mean_kpa).pressure_kpa
        model, s = self.empirical_model(surface)

        def empirical(x_mm: FloatArray, mean_kpa: FloatArray) -> FloatArray:
            share = mean_kpa / self.scene.background.mean_kpa
            return np.asarray(share[:, None] * model.surface_pressure(s[None, :], x_mm[:, None]))

        return empirical

    def empirical_model(self, surface: plane.SurfaceCompliance) -> tuple[plane.EmpiricalModel, FloatArray]:
        """Eqs 1 to 4 fitted to a frame far from the lump and one over it, and the taxels' places across the head."""
        assert self.lump is not None
        nominal = self.scene.background.mean_kpa
        far, over = self._far(nominal), self._over(surface, self.lump[1], np.zeros(1), nominal)
        d, half = surface.body.d_mm, self.head.half_width_mm
        return plane.fit_empirical(over.s_mm, far.at(0.0), over.at(0.0), d_mm=d, half_width_mm=half), over.s_mm

    def _far(self, mean_kpa: float | FloatArray) -> plane.LineFrames:
        far = plane.press_layers(self.scene.layers, head=self.head, mean_kpa=mean_kpa, cell_mm=self.cell_mm)
        return far.as_taxels(self.scene.head.pitch_mm)

    def _over(
        self, surface: plane.SurfaceCompliance, ratio: float, x_mm: FloatArray, mean_kpa: float | FloatArray
    ) -> plane.LineFrames:
        over = plane.press(surface, ratio, x_mm, head=self.head, mean_kpa=mean_kpa)
        return over.as_taxels(self.scene.head.pitch_mm)


def _cylinder(lump: SolidLump, layers: Layers, fidelity: str) -> tuple[Body, float]:
    """Body and stiffness ratio of the lump's section."""
    if lump.height_mm is not None and lump.height_mm != lump.d_mm:
        raise BadDataError(
            f"lump[0].height_mm is {lump.height_mm:g}",
            way_out=f"the {fidelity} model has a circle: leave it out, or use --fidelity solid",
        )
    seat = (layers.fat_mm - lump.depth_mm) / (lump.d_mm / 2)
    if not -1e-9 <= seat <= MOST_SEAT + 1e-9:
        raise BadDataError(
            f"the gland lies {layers.fat_mm:g} mm deep, which seats lump[0] at {seat:.3g}",
            way_out=f"the {fidelity} model has seats from 0 to {MOST_SEAT:g}; use --fidelity solid",
        )
    seat = float(np.clip(seat, 0.0, MOST_SEAT))
    tissue = layers.thickness_mm, layers.fat_kpa, layers.gland_ratio, layers.poisson
    try:
        section = Body(lump.d_mm, lump.depth_ratio, seat, *tissue)
    except BadDataError as error:
        raise BadDataError(f"lump[0]: {error.what}", way_out=error.way_out) from None
    return section, lump.stiffness_ratio


# --- Frames of the head on a layered body with lumps, in three dimensions (record 0024).
#
# The skin's compliance under the head is the exact one of the layers without a lump, plus the change by each lump,
# condensed to a few functions about the lump's vertical axis. Several lumps are summed as if each were alone.

RANK_TOLERANCE: Final = 1e-5  #: Least share of the largest eigenvalue for a function that counts.
STEP_MM: Final = 0.05  #: Step of the tables in r: linear interpolation errs by less than 1e-4 of a function.
TABLE_MM: Final = 75.0  #: Largest r in the tables.
_LEAST_WEIGHT: Final = 1e-6  #: Least sum of squares under the face, over a square's own compliance, of such a function.
_DIRECTIONS: Final = 24  #: Directions of the ring that represents a square when a function is averaged over it.


class SkinPerturbation(Record, eq=False):
    r"""Low-rank change of the skin's compliance by one lump.

    :math:`\Delta C(x, y) = \sum_k s_k f_k(r_x) f_k(r_y) \cos m_k(\theta_x - \theta_y)`.
    """

    table: FloatArray
    """(t, k) array: Functions of the distance from the lump's axis, every 0.05 mm, in mm (kPa mm^2)^(-1/2)."""
    order: NDArray[np.int64]  #: (k,) array: Angular order of each function.
    sign: FloatArray  #: (k,) array: -1 where the lump stiffens.
    x_mm: float = 0.0
    y_mm: float = 0.0  #: `x_mm`, `y_mm`: Place of the lump's axis in the scene's `plane`.

    def vectors(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, c) values at points of the plane, and (c,) signs: the change is ``values diag(signs) values^T``.

        Orders above 0 give two columns, for the cosine and the sine of the angle.
        """
        x_mm, y_mm = x_mm - self.x_mm, y_mm - self.y_mm
        distance = np.hypot(x_mm, y_mm) / STEP_MM
        below = np.minimum(distance.astype(np.int64), len(self.table) - 2)
        share = np.clip(distance - below, 0.0, 1.0)[:, None]
        value = (1.0 - share) * self.table[below] + share * self.table[below + 1]
        phase = np.multiply.outer(np.arctan2(y_mm, x_mm), np.arange(int(self.order.max(initial=0)) + 1))
        angular = self.order > 0
        cosine = value * np.cos(phase)[:, self.order]
        sine = value[:, angular] * np.sin(phase)[:, self.order[angular]]
        return np.concatenate([cosine, sine], axis=1), np.concatenate([self.sign, self.sign[angular]])


def skin_perturbation(
    condensed: CondensedLump, lump_kpa: float, *, square_mm: float = HEAD_PITCH_MM, tolerance: float = RANK_TOLERANCE
) -> SkinPerturbation:
    """Leading functions of a lump's perturbation, down to a share `tolerance` of the largest eigenvalue.

    Load and displacement are averaged over squares of `square_mm`; 0 for points.
    """
    parts = [(order, *np.linalg.eigh(matrix)) for order, matrix in enumerate(condensed.perturbation(lump_kpa))]
    largest = max(float(np.abs(value).max()) for _, value, _ in parts)
    last = float(condensed.radius_mm[-1])
    r: FloatArray = STEP_MM * np.arange(int(np.ceil(min(TABLE_MM, last) / STEP_MM)) + 1, dtype=np.float64)
    tables, orders, signs = [np.zeros((len(r), 0))], [], []
    for order, value, vector in parts:
        leading = np.abs(value) > tolerance * largest
        spline = skin_spline(condensed.radius_mm, vector[:, leading] * np.sqrt(np.abs(value[leading])), order=order)
        tables.append(square_mean(spline, r, order=order, square_mm=square_mm, last_mm=last))
        orders += [order] * int(leading.sum())
        signs += list(np.sign(value[leading]))
    return SkinPerturbation(np.concatenate(tables, axis=1), np.array(orders, dtype=np.int64), np.array(signs))


def square_mean(
    function: Callable[[FloatArray], FloatArray], r_mm: FloatArray, *, order: int, square_mm: float, last_mm: float
) -> FloatArray:
    """(t, k) means of ``function(r) cos(m theta)`` over a square about a point at angle 0, at distances `r_mm`.

    The centre with weight 2/7 and a ring of radius side sqrt(7/30) with 5/7 have the square's second and fourth radial
    moments; of the fourth power only the part that depends on the square's rotation is lost.
    """
    angle = (np.arange(_DIRECTIONS) + 0.5) * (2 * np.pi / _DIRECTIONS)
    x = r_mm[:, None] + square_mm * np.sqrt(7.0 / 30.0) * np.cos(angle)
    y = np.broadcast_to(square_mm * np.sqrt(7.0 / 30.0) * np.sin(angle), x.shape)
    value = function(np.minimum(np.hypot(x, y), last_mm))
    ring = np.einsum("rdk,rd->rk", value, np.cos(order * np.arctan2(y, x))) / _DIRECTIONS
    return np.asarray((2.0 * function(np.minimum(r_mm, last_mm)) + 5.0 * ring) / 7.0)


def head_face(head: Head) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Squares of a head's face, taxels and those with centres on its rim, and the mask of the taxels; see `SolidHead`.

    Across the head the face is a `scene.HeadSection` with its shoulders outside; along it the rim, a quarter round, is
    tangent to a line. Without a rim a flat end would press like a punch, with a singular pressure along its edge; with
    shoulders inside there is none.
    """
    rows, columns, pitch_mm, radius_mm = head.rows, head.columns, head.pitch_mm, head.radius_mm
    rim_mm = 0.0 if head.shoulder_mm > 0 else head.rim_mm
    half_x, half_y = rows * pitch_mm / 2, columns * pitch_mm / 2
    section = HeadSection(2 * half_x, radius_mm, rim_mm, SHOULDERS_OUTSIDE)
    rim_x = _rim_squares(half_x, section.half_face_mm, pitch_mm)
    rim_y = _rim_squares(half_y, half_y + rim_mm, pitch_mm)
    x, y = ((np.arange(float(n)) - (n - 1) / 2) * pitch_mm for n in (rows + 2 * rim_x, columns + 2 * rim_y))
    across = -section.profile_mm(x)
    along = np.sqrt(np.maximum(rim_mm**2 - np.clip(np.abs(y) - half_y, 0.0, None) ** 2, 0.0)) - rim_mm
    surface = np.stack(np.broadcast_arrays(x[:, None], y[None, :], across[:, None] + along[None, :]), axis=-1).copy()
    sensing = np.zeros(surface.shape[:2], dtype=bool)
    sensing[rim_x : rim_x + rows, rim_y : rim_y + columns] = True
    surface[sensing] = head.surface_mm().reshape(-1, 3)
    return surface, sensing


def _rim_squares(half_mm: float, reach_mm: float, pitch_mm: float) -> int:
    """Number of squares beyond `half_mm` whose centres are nearer than `reach_mm`."""
    return max(0, int(np.ceil((reach_mm - half_mm) / pitch_mm - 0.5 - 1e-9)))


class SolidHead(Record, eq=False):
    """A rigid head on a layered body, by the squares of its face that can touch the skin; made by `solid_head`."""

    surface_mm: FloatArray
    """(rows, columns, 3) array: Centres in `scanhead`: origin at the apex of the face, z into the tissue."""
    sensing: NDArray[np.bool_]  #: (rows, columns) bool array: True for taxels, False for the rim around them.
    pitch_mm: float
    plain: ContactStiffness  #: Stiffness of the skin under the face, without lumps.

    def frame(
        self,
        lumps: Sequence[SkinPerturbation],
        rotation: FloatArray,
        at_mm: Sequence[float] | FloatArray,
        *,
        mean_kpa: float,
        touching: NDArray[np.bool_] | None = None,
    ) -> tuple[FloatArray, Contact]:
        """(rows, columns) pressures of the taxels, and the contact of the whole face, at a pose and a mean pressure.

        ``p_plane = rotation @ p_scanhead + (*at_mm[:2], contact.depth_mm)``: z = 0 is the undisturbed skin, and only
        the depth adapts. `mean_kpa` is over the taxels; `touching`, a neighbouring frame's, is the solver's start.
        """
        place, sensing = self.surface_mm.reshape(-1, 3) @ rotation.T, self.sensing
        parts, signs = [np.zeros((len(place), 0))], []
        for lump in lumps:
            values, sign = lump.vectors(place[:, 0] + at_mm[0], place[:, 1] + at_mm[1])
            values = values * self.pitch_mm  # a pressure of 1 kPa on a square is a force of pitch^2
            weight = np.einsum("nk,nk->k", values, values)
            counts = weight > _LEAST_WEIGHT * float(np.diag(self.plain.plain).mean()) ** -1
            parts.append(values[:, counts])
            signs.append(sign[counts])
        vectors = np.concatenate(parts, axis=1)
        stiffness = self.plain.changed(vectors, np.concatenate(signs)) if vectors.shape[1] else self.plain
        contact = solve_contact(stiffness, -place[:, 2], mean_kpa=mean_kpa, counted=sensing.ravel(), touching=touching)
        shape = int(sensing.any(axis=1).sum()), -1
        return contact.pressure_kpa[sensing.ravel()].reshape(shape), contact


def solid_head(head: Head, layers: Layers) -> SolidHead:
    """Head on a body without lumps; its curvature and tilt enter as heights over flat skin (Johnson 1985, ch. 4)."""
    surface, sensing = head_face(head)
    rows, columns = sensing.shape
    compliance = taxel_compliance(layers, rows=rows, columns=columns, pitch_mm=head.pitch_mm)
    return SolidHead(surface, sensing, head.pitch_mm, ContactStiffness.of(compliance))


# --- Three-dimensional scans of lumps of tissue in a layered body, solved frame by frame.
#
# The mean over the taxels is the scene's background, as an examiner keeps it by the tone, and the head sinks less over
# a lump. Each frame is at rest: nothing slides, creeps or lags. Ribs are rows of balls.


def frames_at_poses(
    scene: Scene, rotation: FloatArray, origin_mm: FloatArray, *, mean_kpa: FloatArray, progress: Progress = no_progress
) -> tuple[FloatArray, FloatArray]:
    """(n, rows, columns) pressures in kPa at poses from `scanhead` to the scene's `plane`, and (n,) depths of the apex.

    The depths, in mm, follow from the mean pressures; both are without noise.
    """
    layers, lumps = scene.layers, []
    head, count = _head(scene.head, layers), len(mean_kpa)
    balls = (ball for rib in scene.ribs for ball in rib.balls())
    for lump in (*scene.solid_lumps, *balls):
        condensed = condensed_lump(lump, layers)
        change = skin_perturbation(condensed, lump.stiffness_ratio * layers.fat_kpa, square_mm=scene.head.pitch_mm)
        lumps.append(replace(change, x_mm=lump.x_mm, y_mm=lump.y_mm))
    pressure = np.empty((count, scene.head.rows, scene.head.columns))
    depth, touching = np.empty(count), None
    for i in range(count):
        kpa = float(mean_kpa[i])
        pressure[i], contact = head.frame(lumps, rotation[i], origin_mm[i], mean_kpa=kpa, touching=touching)
        depth[i], touching = contact.depth_mm, contact.touching
        progress(i + 1, count)
    return pressure, depth


def condensed_lump(lump: SolidLump, layers: Layers) -> CondensedLump:
    """Body condensed around a lump, for any stiffness and place of the lump."""
    return _condensed(mesh.LumpGeometry(lump.d_mm / 2, lump.vertical_mm / 2, lump.depth_mm, layers))


_CACHE_SIZE = 8  #: Exams of one body, and lumps of one size and depth in it, share these; a scene has few.
_condensed = lru_cache(maxsize=_CACHE_SIZE)(condense_lump)
_head = lru_cache(maxsize=_CACHE_SIZE)(solid_head)
