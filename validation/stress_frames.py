"""Scans of bodies that break one assumption of the solid model each: its frames, solved with one thing changed.

What is changed, and how it is derived:

- `depth_mm` of a `VaryingLayers`: fat or chest wall whose depth varies along one direction. The skin's compliance
  between two squares is that of even layers of the depth half way between them, the leading term where depths change
  little over a head. The lump's own perturbation stays that of the depth above it.
- `skin_radius_mm`: a convex skin. In the contact only the relative curvature of head and skin counts (Johnson 1985,
  ch. 4), so the head's face falls away by r^2 / (2 R) more. The examiner keeps the head square to the skin, so that the
  tracker's poses follow the curve.
- `lag_mm`: the lump is dragged along by this much in each stroke's direction.
- `friction`: the sliding head pulls the skin along with mu times the pressure (Coulomb). The skin's sinking under this
  shear is exact for the layers; the pressures that cause it are those of the frame before.
- `local_stiffening` k: the modulus under a square is E (1 - k + k p / 9.5 kPa), within half and twice E, with p the
  mean pressure within some 5 mm: a secant modulus, found in two steps from the frame before. All tissue stiffens alike.
- `gland_stiffening` k: gland and lump, but not fat, have E (1 - k + k p / 9.5 kPa) with p the frame's mean. Krouskop et
  al. (1998, Ultrasonic Imaging 20) found fat's modulus nearly constant between 5 and 20 % of compression, that of gland
  doubled and those of carcinomas several-fold.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.forward.axisymmetric import skin_flexibility, taxel_compliance
from tactile_bayes.forward.contact import Contact, ContactStiffness
from tactile_bayes.forward.scene import Scene, frame_times, head_poses, level_kpa, record, rotation_from_vector
from tactile_bayes.forward.simulate import (
    SkinPerturbation,
    SolidHead,
    condensed_lump,
    skin_perturbation,
    solid_head,
)
from tactile_bayes.forward.tissue import Layers
from tactile_bayes.geometry import FloatArray, apply, inverse, quaternion_from_rotation, rotation_from_quaternion
from tactile_bayes.scans import Scan, TrackerPoses

REFERENCE_KPA = 9.5
FACTORS = (0.5, 2.0)
"""Least and largest of a modulus under local stiffening."""
_NEAR_MM = 5.0
LEAST_LAYER_MM = 3.0
_DEPTHS = 14
_GRID_MM = 5.0
_SLOW_MM_S = 10.0


@dataclass(frozen=True, slots=True)
class VaryingLayers:
    """Depth of the fat, or of the chest wall, that varies along one direction of the scene's `plane`.

    Parameters
    ----------
    layer
        ``"fat"`` or ``"wall"``.
    depth_mm
        From distances along the direction, mm from the lump, and the depth at the lump to depths in mm.
    angle_rad
        The direction, from x towards y.
    """

    layer: str
    depth_mm: Callable[[FloatArray, float], FloatArray]
    angle_rad: float


@dataclass(frozen=True, slots=True)
class Physics:
    """What differs from the solid model; the defaults are the solid model itself. See the head of the module."""

    varying: VaryingLayers | None = None
    skin_radius_mm: float = np.inf
    lag_mm: float = 0.0
    friction: float = 0.0
    local_stiffening: float = 0.0
    gland_stiffening: float = 0.0


def stressed_scan(scene: Scene, physics: Physics, *, empty: bool = False) -> Scan:
    """Scan of a scene with one lump and a body, by the changed physics; its noise is that of `simulate`.

    `empty` leaves the lump out; its place and depth still say where the layers are.
    """
    time = frame_times(scene)
    pressure, depth = stressed_frames(scene, time, physics, empty=empty)
    done = record(
        scene,
        pressure=lambda at: pressure[np.searchsorted(time, at)],
        depth=lambda at: np.interp(at, time, depth),
        truth={"lumps": []},
        rng=np.random.default_rng(scene.seed),
    )
    return done.scan if np.isinf(physics.skin_radius_mm) else on_sphere(scene, done.scan, physics.skin_radius_mm)


def on_sphere(scene: Scene, scan: Scan, radius_mm: float) -> Scan:
    """The scan with its strokes bent onto a sphere that touches the scene's `plane`, arc length for length."""
    base, lever = scene.tracker.base_from_plane(), scene.tracker.scanhead_from_tracker()
    to_plane = inverse(base)
    attitude = to_plane[:3, :3] @ rotation_from_quaternion(scan.poses.quaternion_wxyz) @ lever[:3, :3].T
    apex = apply(to_plane, scan.poses.position_mm) - attitude @ lever[:3, 3]
    turn = np.stack([apex[:, 1], -apex[:, 0], np.zeros(len(apex))], axis=-1) / radius_mm
    bend = rotation_from_vector(turn)
    # the sphere's middle lies below the skin, and z runs into the tissue
    middle = np.array([0.0, 0.0, radius_mm])
    apex = middle + bend @ np.array([0.0, 0.0, -1.0]) * (radius_mm - apex[:, 2])[:, None]
    attitude = bend @ attitude
    position = apply(base, apex + attitude @ lever[:3, 3])
    rotation = base[:3, :3] @ attitude @ lever[:3, :3]
    quaternion = np.array([quaternion_from_rotation(one) for one in rotation])
    return replace(scan, poses=TrackerPoses(scan.poses.time_s, position, quaternion))


def stressed_frames(
    scene: Scene, time_s: FloatArray, physics: Physics, *, empty: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Pressures (n, rows, columns) and depths (n,) as `frames_at_poses` returns them, by the changed physics."""
    rotation, origin = head_poses(scene, time_s)
    level = level_kpa(scene.background, time_s)
    way = np.tanh(np.gradient(origin[:, 0], time_s) / _SLOW_MM_S)
    model = _Model.of(scene, physics, level)
    if empty:
        model = dataclasses.replace(model, stages=[(head, _nothing(lump)) for head, lump in model.stages])
    pressure = np.empty((len(time_s), scene.head.rows, scene.head.columns))
    depth, before = np.empty(len(time_s)), None
    for i in range(len(time_s)):
        pressure[i], before = model.frame(rotation[i], origin[i], kpa=float(level[i]), way=float(way[i]), before=before)
        depth[i] = before.depth_mm
    return pressure, depth


def _nothing(lump: SkinPerturbation) -> SkinPerturbation:
    return replace(lump, table=0.0 * lump.table)


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """A head over a body, with what its frames need.

    Parameters
    ----------
    stages
        The head on the body and the lump, at one mean pressure or at two between which frames are interpolated.
    stage_kpa
        Those pressures.
    grid
        Where layers vary: the head at places along the direction, instead of the stages' own.
    shear : two (n, n) arrays
        Sinking under shear along the head's x and y axes; empty without friction.
    near : (n, n) array
        Takes pressures to their means about each square.
    """

    physics: Physics
    stages: Sequence[tuple[SolidHead, SkinPerturbation]]
    stage_kpa: Sequence[float]
    grid: tuple[FloatArray, Sequence[SolidHead]] | None
    shear: tuple[FloatArray, ...]
    near: FloatArray

    @classmethod
    def of(cls, scene: Scene, physics: Physics, level: FloatArray) -> _Model:
        layers, lump = scene.layers, scene.solid_lumps[0]
        k = physics.gland_stiffening
        kpa = np.quantile(level[level > 4.0], [0.05, 0.95]) if k else [REFERENCE_KPA]
        stages = []
        for one in kpa:
            factor = 1.0 - k + k * float(one) / REFERENCE_KPA
            stiffened = replace(layers, gland_ratio=layers.gland_ratio * factor)
            change = skin_perturbation(
                condensed_lump(lump, stiffened),
                lump.stiffness_ratio * factor * layers.fat_kpa,
                square_mm=scene.head.pitch_mm,
            )
            stages.append((_kept_head(scene.head, stiffened), replace(change, x_mm=lump.x_mm, y_mm=lump.y_mm)))
        grid = None if physics.varying is None else _grid(scene, layers, physics.varying, stages[0][0])
        head = stages[0][0]
        shear: tuple[FloatArray, ...] = ()
        if physics.friction:
            shear = _shear_sinking(layers, head.sensing.shape, head.pitch_mm)
        return cls(physics, stages, [float(one) for one in kpa], grid, shear, _near(head.surface_mm))

    def frame(
        self, rotation: FloatArray, origin: FloatArray, *, kpa: float, way: float, before: Contact | None
    ) -> tuple[FloatArray, Contact]:
        """The frame at a pose, after the frame `before`; `way` is -1 to 1 along the strokes."""
        head, lumps = self._mixed(kpa)
        if self.grid is not None:
            head = self._on_grid(origin)
        lumps = [replace(one, x_mm=one.x_mm + self.physics.lag_mm * way) for one in lumps]
        head = replace(head, surface_mm=self._surface(head, way * rotation[0], before))

        def solved(head: SolidHead, lumps: Sequence[Any]) -> tuple[FloatArray, Contact]:
            touching = None if before is None else before.touching
            return head.frame(lumps, rotation, origin, mean_kpa=kpa, touching=touching)

        k = self.physics.local_stiffening
        if not k or kpa <= 0:
            return solved(head, lumps)
        contact = before or solved(head, lumps)[1]
        for _ in range(2):
            factor = np.clip(1.0 - k + k * (self.near @ contact.pressure_kpa) / REFERENCE_KPA, *FACTORS)
            root = np.sqrt(factor)
            pressure, contact = solved(_scaled_head(head, root), [_Scaled(one, root) for one in lumps])
        return pressure, contact

    def _mixed(self, kpa: float) -> tuple[SolidHead, list[SkinPerturbation]]:
        """Head and lumps at a mean pressure: compliance and stiffness are linear between the two stages."""
        if len(self.stages) == 1:
            return self.stages[0][0], [self.stages[0][1]]
        (low, low_lump), (high, high_lump) = self.stages
        share = float(np.clip((kpa - self.stage_kpa[0]) / (self.stage_kpa[1] - self.stage_kpa[0]), 0.0, 1.0))
        plain = (1.0 - share) * low.plain.plain + share * high.plain.plain
        parts = [(low_lump, 1.0 - share), (high_lump, share)]
        lumps = [replace(one, table=one.table * np.sqrt(weight)) for one, weight in parts if weight > 0]
        return replace(low, plain=replace(low.plain, plain=plain)), lumps

    def _on_grid(self, origin: FloatArray) -> SolidHead:
        assert self.grid is not None
        assert self.physics.varying is not None
        place, heads = self.grid
        angle = self.physics.varying.angle_rad
        at = float(
            np.clip(
                (np.cos(angle) * origin[0] + np.sin(angle) * origin[1] - place[0]) / _GRID_MM, 0, len(place) - 1.001
            )
        )
        below, share = int(at), at - int(at)
        plain = (1.0 - share) * heads[below].plain.plain + share * heads[below + 1].plain.plain
        return replace(heads[below], plain=replace(heads[below].plain, plain=plain))

    def _surface(self, head: SolidHead, way: FloatArray, before: Contact | None) -> FloatArray:
        """(rows, columns, 3) face of the head, with what the skin's curvature and the shear add to its distance.

        `way` is the direction of the stroke in the head's axes.
        """
        surface = head.surface_mm.copy()
        surface[..., 2] -= (surface[..., 0] ** 2 + surface[..., 1] ** 2) / (2.0 * self.physics.skin_radius_mm)
        if self.shear and before is not None:
            along_x, along_y = (one @ before.pressure_kpa for one in self.shear)
            sunk = self.physics.friction * (way[0] * along_x + way[1] * along_y)
            surface[..., 2] -= sunk.reshape(surface.shape[:2])
        return surface


_kept_head = lru_cache(maxsize=8)(solid_head)


@dataclass(frozen=True, slots=True, eq=False)
class _Scaled:
    """A perturbation whose functions are divided, square by square, by the root of how much stiffer the tissue is."""

    whole: Any
    root: FloatArray

    def vectors(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        values, signs = self.whole.vectors(x_mm, y_mm)
        return values / self.root[:, None], signs


def _scaled_head(head: SolidHead, root: FloatArray) -> SolidHead:
    plain = head.plain.plain * root[:, None] * root[None, :]
    return replace(head, plain=ContactStiffness(plain, head.plain.factor, head.plain.core))


def _grid(scene: Scene, layers: Layers, varying: VaryingLayers, head: SolidHead) -> tuple[FloatArray, list[SolidHead]]:
    """The head at places 5 mm apart along the direction in which the layers vary; yaw is the strokes' own."""
    lump, strokes = scene.solid_lumps[0], scene.strokes
    angle = varying.angle_rad
    reach = np.hypot(strokes.half_length_mm, strokes.lines * strokes.spacing_mm / 2) + 2 * strokes.wander_mm + _GRID_MM
    place: FloatArray = np.arange(-reach, reach + _GRID_MM, _GRID_MM)
    turned = angle - np.radians(strokes.yaw_deg)
    across = head.surface_mm[..., 0].ravel() * np.cos(turned) + head.surface_mm[..., 1].ravel() * np.sin(turned)
    middle = (across[:, None] + across[None, :]) / 2
    lump_at = lump.x_mm * np.cos(angle) + lump.y_mm * np.sin(angle)
    own = layers.fat_mm if varying.layer == "fat" else layers.thickness_mm
    least, most = (
        (LEAST_LAYER_MM, layers.thickness_mm - LEAST_LAYER_MM)
        if varying.layer == "fat"
        else (layers.fat_mm + LEAST_LAYER_MM, np.inf)
    )

    def depth(at: FloatArray) -> FloatArray:
        return np.clip(varying.depth_mm(at - lump_at, own), least, most)

    ends = depth(np.linspace(place[0] + across.min(), place[-1] + across.max(), 400))
    table_mm = np.geomspace(ends.min() * 0.999, ends.max() * 1.001, _DEPTHS)
    rows, columns = head.sensing.shape
    table = np.stack(
        [_by_offset(_with_depth(layers, varying.layer, one), rows, columns, head.pitch_mm) for one in table_mm]
    )
    row, column = np.divmod(np.arange(rows * columns), columns)
    offset = np.abs(row[:, None] - row) * columns + np.abs(column[:, None] - column)
    heads = []
    for at in place:
        index = np.interp(depth(at + middle), table_mm, np.arange(_DEPTHS))
        below = np.minimum(index.astype(np.int64), _DEPTHS - 2)
        share = index - below
        compliance = (1.0 - share) * table[below, offset] + share * table[below + 1, offset]
        heads.append(replace(head, plain=ContactStiffness.of(compliance)))
    return place, heads


def _with_depth(layers: Layers, layer: str, depth_mm: float) -> Layers:
    depth_mm = float(depth_mm)
    return replace(layers, **{"fat_mm" if layer == "fat" else "thickness_mm": depth_mm})


def _by_offset(layers: Layers, rows: int, columns: int, pitch_mm: float) -> FloatArray:
    """(rows * columns,) compliance by how many rows and columns two squares are apart."""
    return np.asarray(taxel_compliance(layers, rows=rows, columns=columns, pitch_mm=pitch_mm)[0])


def shear_sinking(r_mm: FloatArray, layers: Layers) -> FloatArray:
    r"""Sinking straight ahead at distance r of a unit shear force along the skin, in mm / (kPa mm^2).

    Parameters
    ----------
    r_mm : (n,) array
        Above 0. At an angle theta from the force the sinking is ``cos(theta)`` times this.

    Notes
    -----
    .. math:: w(r, \theta) = -\frac{\cos\theta}{2\pi} \int_0^\infty F_{10}(k) J_1(kr)\, k\, dk

    with :math:`F_{10}` of `skin_flexibility`: a shear along x with Fourier component q has the longitudinal part
    :math:`i (k_x / k) q`, and the angular integral of :math:`i \cos\varphi\, e^{ikr\cos(\varphi - \theta)}` is
    :math:`-2\pi J_1(kr) \cos\theta`. What :math:`F_{10} k` tends to is taken off and added in closed form, because
    :math:`\int J_1(kr)\,dk = 1/r`: for a half-space that is all (Johnson 1985, eq. 3.75).
    """
    from scipy.special import j1

    r, nu, modulus = np.asarray(r_mm, dtype=np.float64), layers.poisson, layers.fat_kpa
    limit = -(1.0 - 2.0 * nu) * (1.0 + nu) / modulus
    most = 18.0 / layers.fat_mm
    node, weight = np.polynomial.legendre.leggauss(24)
    edges = np.linspace(0.0, most, 2 + int(np.ceil(most * float(r.max()) / 8.0)))
    half = np.diff(edges)[:, None] / 2
    k, weights = (edges[:-1, None] + half * (1.0 + node)).ravel(), (half * weight).ravel()
    safe = np.maximum(k, 1e-3 / max(layers.thickness_mm, 1.0))
    bracket = skin_flexibility(safe, layers)[:, 1, 0] * safe - limit
    return np.asarray(-(j1(np.multiply.outer(r, k)) @ (weights * bracket) + limit / r) / (2.0 * np.pi))


def _shear_sinking(layers: Layers, shape: tuple[int, ...], pitch_mm: float) -> tuple[FloatArray, FloatArray]:
    """Two (n, n) arrays: sinking of square i for unit shear along the head's x and y on square j, in mm / kPa."""
    rows, columns = shape
    row, column = np.divmod(np.arange(rows * columns), columns)
    dx, dy = (row[:, None] - row) * pitch_mm, (column[:, None] - column) * pitch_mm
    r = np.maximum(np.hypot(dx, dy), pitch_mm)
    table_mm = np.linspace(pitch_mm, float(r.max()) + pitch_mm, 300)
    value = np.interp(r, table_mm, shear_sinking(table_mm, layers)) * pitch_mm**2 / r
    return np.asarray(value * dx), np.asarray(value * dy)


def _near(surface_mm: FloatArray) -> FloatArray:
    """(n, n) Gaussian weights about each square of a face, rows adding up to 1."""
    place = surface_mm[..., :2].reshape(-1, 2)
    square = ((place[:, None] - place) ** 2).sum(axis=-1)
    weight = np.exp(-0.5 * square / _NEAR_MM**2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
