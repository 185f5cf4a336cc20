"""The solid model's frames and scans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.forward.axisymmetric import CondensedLump, LayeredBody, condense_lump, skin_spline, taxel_compliance
from tactile_bayes.forward.contact import Contact, ContactStiffness, solve_contact
from tactile_bayes.forward.mesh import LumpGeometry
from tactile_bayes.forward.scene import (
    Head,
    Scene,
    SimulatedScan,
    frame_times,
    head_positions,
    level_kpa,
    record,
    tissue_truth,
)
from tactile_bayes.forward.tissue import HeadFace, SceneBody, SolidLump, fat_thickness, head_face
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM

# --- Frames of the head on a layered body with lumps, in three dimensions.
#
# The skin's compliance under the head is the exact one of the layers without a lump, plus what each lump changes,
# condensed to a few functions about the lump's vertical axis. Several lumps are summed as if each were alone.

RANK_TOLERANCE: Final = 1e-5  #: Functions that carry less than this share of the largest are left out.
# Step of the tables in r: linear interpolation between entries is then off by less than 1e-4 of a function.
STEP_MM: Final = 0.05
REACH_MM: Final = 75.0  #: Largest r in the tables.
# Functions with a sum of squares under the face below this share of a square's own compliance are left out of a frame.
_LEAST_WEIGHT: Final = 1e-6
_DIRECTIONS: Final = 24  #: Directions of the ring that stands for a square when a function is averaged over it.


class SkinPerturbation(Record, eq=False):
    r"""Low-rank change of the skin's compliance by one lump.

    :math:`\Delta C(x, y) = \sum_k s_k f_k(r_x) f_k(r_y) \cos m_k(\theta_x - \theta_y)`.
    """

    table: FloatArray
    """(t, k) array: functions of the distance from the lump's axis, every 0.05 mm, in mm (kPa mm^2)^(-1/2)."""
    order: NDArray[np.int64]  #: (k,) array: angular order of each.
    sign: FloatArray  #: (k,) array: -1 where the lump stiffens.

    @property
    def reach_mm(self) -> float:
        """Distance beyond which the change is neglected."""
        return (len(self.table) - 1) * STEP_MM

    def vectors(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, c) values at points relative to the axis, and (c,) signs: the change is ``values diag(signs) values^T``.

        Orders above 0 give two columns, for the cosine and the sine of the angle.
        """
        distance = np.hypot(x_mm, y_mm) / STEP_MM
        below = np.minimum(distance.astype(np.int64), len(self.table) - 2)
        share = np.clip(distance - below, 0.0, 1.0)[:, None]
        value = (1.0 - share) * self.table[below] + share * self.table[below + 1]
        angle = np.arctan2(y_mm, x_mm)
        turns = np.arange(int(self.order.max(initial=0)) + 1)
        phase = np.multiply.outer(angle, turns)
        twice = self.order > 0
        cosine = value * np.cos(phase)[:, self.order]
        sine = value[:, twice] * np.sin(phase)[:, self.order[twice]]
        return np.concatenate([cosine, sine], axis=1), np.concatenate([self.sign, self.sign[twice]])


def skin_perturbation(
    condensed: CondensedLump, lump_kpa: float, *, square_mm: float = HEAD_PITCH_MM, tolerance: float = RANK_TOLERANCE
) -> SkinPerturbation:
    """Condense a lump's perturbation to its leading functions, those above a share `tolerance` of the largest
    eigenvalue.

    Load and displacement are averaged over squares of `square_mm`; 0 for points.
    """
    parts = [(mode.order, *np.linalg.eigh(mode.matrix)) for mode in condensed.perturbation(lump_kpa)]
    largest = max(float(np.abs(value).max()) for _, value, _ in parts)
    r: FloatArray = (
        np.arange(int(np.ceil(min(REACH_MM, condensed.radius_mm[-1]) / STEP_MM)) + 1, dtype=np.float64) * STEP_MM
    )
    tables, orders, signs = [np.zeros((len(r), 0))], [], []
    for order, value, vector in parts:
        kept = np.abs(value) > tolerance * largest
        spline = skin_spline(condensed.radius_mm, vector[:, kept] * np.sqrt(np.abs(value[kept])), order=order)
        tables.append(square_mean(spline, r, order=order, square_mm=square_mm, last_mm=float(condensed.radius_mm[-1])))
        orders += [order] * int(kept.sum())
        signs += list(np.sign(value[kept]))
    return SkinPerturbation(np.concatenate(tables, axis=1), np.array(orders, dtype=np.int64), np.array(signs))


def square_mean(
    function: Callable[[FloatArray], FloatArray], r_mm: FloatArray, *, order: int, square_mm: float, last_mm: float
) -> FloatArray:
    """(t, k) means of ``function(r) cos(m theta)`` over a square about a point at angle 0, at distances `r_mm`.

    The centre with weight 2/7 and a ring of radius side sqrt(7/30) with 5/7 have the square's second and fourth radial
    moments, so only the fourth power that depends on how the square is turned is lost.
    """
    angle = (np.arange(_DIRECTIONS) + 0.5) * (2 * np.pi / _DIRECTIONS)
    x = r_mm[:, None] + square_mm * np.sqrt(7.0 / 30.0) * np.cos(angle)
    y = np.broadcast_to(square_mm * np.sqrt(7.0 / 30.0) * np.sin(angle), x.shape)
    value = function(np.minimum(np.hypot(x, y), last_mm))
    ring = np.einsum("rdk,rd->rk", value, np.cos(order * np.arctan2(y, x))) / _DIRECTIONS
    return np.asarray((2.0 * function(np.minimum(r_mm, last_mm)) + 5.0 * ring) / 7.0)


class PlacedLump(Record, eq=False):
    """A perturbation and the place of its axis in the scene's `plane`, mm."""

    perturbation: SkinPerturbation
    x_mm: float
    y_mm: float


class SolidFrame(Record, eq=False):
    """The solved frame of a head at one pose."""

    pressure_kpa: FloatArray  #: (rows, columns) array: Mean pressure on each taxel.
    depth_mm: float  #: z of the head's origin in the scene's `plane`, whose z = 0 is the undisturbed skin.
    contact: Contact  #: Of the whole face, rim included.


class SolidHead(Record, eq=False):
    """A rigid head on a layered body; made by `solid_head`."""

    face: HeadFace  #: Squares that can touch.
    plain: ContactStiffness  #: Stiffness of the skin under the face, without lumps.

    def frame(
        self,
        lumps: Sequence[PlacedLump],
        *,
        rotation: FloatArray,
        x_mm: float,
        y_mm: float,
        mean_kpa: float,
        touching: NDArray[np.bool_] | None = None,
    ) -> SolidFrame:
        """Pressures of the head at a pose and a mean over the taxels: what the examiner's tone holds, and the gate of a
        map looks at.

        ``p_plane = rotation @ p_scanhead + (x, y, depth)``. The head keeps its rotation; only the depth adapts.
        `touching` is where to start: `contact.touching` of a neighbouring frame.
        """
        place = self.face.surface_mm.reshape(-1, 3) @ rotation.T
        stiffness = self.plain
        parts = [self._vectors(lump, place[:, 0] + x_mm, place[:, 1] + y_mm) for lump in lumps]
        vectors = np.concatenate([np.zeros((len(place), 0)), *[vector for vector, _ in parts]], axis=1)
        if vectors.shape[1]:
            stiffness = stiffness.changed(vectors, np.concatenate([sign for _, sign in parts]))
        contact = solve_contact(
            stiffness, -place[:, 2], mean_kpa=mean_kpa, counted=self.face.sensing.ravel(), touching=touching
        )
        return SolidFrame(self.face.taxel_frame(contact.pressure_kpa), contact.depth_mm, contact)

    def _vectors(self, lump: PlacedLump, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change by one lump under the face, per unit pressure on a square; negligible parts are dropped."""
        values, signs = lump.perturbation.vectors(x_mm - lump.x_mm, y_mm - lump.y_mm)
        values = values * self.face.pitch_mm  # a pressure of 1 kPa on a square is a force of pitch^2
        weight = np.einsum("nk,nk->k", values, values)
        kept = weight > _LEAST_WEIGHT * float(np.diag(self.plain.plain).mean()) ** -1
        return values[:, kept], signs[kept]


def solid_head(face: HeadFace, body: LayeredBody) -> SolidHead:
    """Prepare a head on a body without lumps.

    The compliance is that of the squares on the flat skin: the head's curvature and tilt enter as heights, as the
    linear theory has it (Johnson 1985, ch. 4).
    """
    rows, columns = face.sensing.shape
    compliance = taxel_compliance(body, rows=rows, columns=columns, pitch_mm=face.pitch_mm)
    return SolidHead(face, ContactStiffness.of(compliance))


# --- Three-dimensional scans of lumps of tissue in a layered body, solved frame by frame.

Progress = Callable[[int, int], None]


def simulate_solid(scene: Scene, *, rng: np.random.Generator, progress: Progress | None = None) -> SimulatedScan:
    """Make a scan of a scene that gives tissue; `rng` is the instrument's alone. Ribs are rows of balls.

    The mean over the taxels follows the scene's background, as an examiner holds it by the tone; where the head sinks
    less, over a lump, its pose says so. Tilts are the scene's. Each frame is at rest: nothing slides, creeps or lags.
    """
    time = frame_times(scene)
    pressure, depth = solid_frames(scene, time, progress=progress)
    return record(
        scene,
        felt=lambda at: pressure[np.searchsorted(time, at)],
        depth=lambda at: np.interp(at, time, depth),
        truth={"model": "solid", "head": scene.head.shoulders, **tissue_truth(scene)},
        rng=rng,
    )


def solid_frames(
    scene: Scene, time_s: FloatArray, *, progress: Progress | None = None
) -> tuple[FloatArray, FloatArray]:
    """Pressures in kPa, (n, rows, columns), on the head at (n,) times, without noise, and z in mm of its apex in the
    scene's `plane`."""
    rotation, origin = head_positions(scene, time_s)
    level = level_kpa(scene.background, time_s)
    return frames_at_poses(scene, rotation, origin, mean_kpa=level, progress=progress)


def frames_at_poses(
    scene: Scene, rotation: FloatArray, origin_mm: FloatArray, *, mean_kpa: FloatArray, progress: Progress | None = None
) -> tuple[FloatArray, FloatArray]:
    """As `solid_frames`, at given poses from `scanhead` to the scene's `plane` and mean pressures, which decide the
    depth."""
    body = scene.body or SceneBody()
    head, lumps = _head(scene.head, body, fat_thickness(body, scene.solid_lumps)), _placed(scene)
    count = len(mean_kpa)
    pressure = np.empty((count, scene.head.rows, scene.head.columns))
    depth, touching = np.empty(count), None
    for i in range(count):
        frame = head.frame(
            lumps,
            rotation=rotation[i],
            x_mm=float(origin_mm[i, 0]),
            y_mm=float(origin_mm[i, 1]),
            mean_kpa=float(mean_kpa[i]),
            touching=touching,
        )
        pressure[i], depth[i], touching = frame.pressure_kpa, frame.depth_mm, frame.contact.touching
        if progress is not None:
            progress(i + 1, count)
    return pressure, depth


def face_of(head: Head) -> HeadFace:
    """Face of the head that can touch the skin; shoulders inside the array leave no room for a rim."""
    rim = 0.0 if head.shoulder_mm > 0 else head.rim_mm
    return head_face(head.surface_mm(), pitch_mm=head.pitch_mm, radius_mm=head.radius_mm, rim_mm=rim)


def layers_of(body: SceneBody, fat_mm: float) -> LayeredBody:
    """The layered body without lumps."""
    return LayeredBody((body.fat_kpa, body.fat_kpa * body.gland_ratio), (fat_mm, body.thickness_mm - fat_mm), body.nu)


def condensed_lump(lump: SolidLump, body: SceneBody, fat_mm: float) -> CondensedLump:
    """Condense the body around a lump; the lump's stiffness and place do not matter here."""
    geometry = LumpGeometry(lump.d_mm / 2, lump.vertical_mm / 2, lump.depth_mm, fat_mm, body.thickness_mm)
    return _condensed(geometry, body)


# Exams of one body, and lumps of one size and depth in it, share these; a scene has few.
_BODIES_KEPT = 8
_condensed = lru_cache(maxsize=_BODIES_KEPT)(condense_lump)


@lru_cache(maxsize=_BODIES_KEPT)
def _head(head: Head, body: SceneBody, fat_mm: float) -> SolidHead:
    return solid_head(face_of(head), layers_of(body, fat_mm))


def _placed(scene: Scene) -> list[PlacedLump]:
    """The scene's lumps with their places."""
    body = scene.body or SceneBody()
    fat = fat_thickness(body, scene.solid_lumps)
    placed = []
    for lump in scene.stiff_balls:
        around = condensed_lump(lump, body, fat)
        change = skin_perturbation(around, lump.stiffness_ratio * body.fat_kpa, square_mm=scene.head.pitch_mm)
        placed.append(PlacedLump(change, lump.x_mm, lump.y_mm))
    return placed
