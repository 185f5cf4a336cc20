"""Frames averaged for comparison, strokes of the head, and the check of a tracker's rotation convention."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import pairwise, permutations, product
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding, finding
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, inverse, principal_axes, rotation_from_quaternion
from tactile_bayes.mapping.cells import MAX_POSE_GAP_MS, FramePoses, Projection
from tactile_bayes.mapping.select import SelectedFrames, chunks
from tactile_bayes.scans import HeadGeometry, Scan, TrackerPoses

# --- Frames averaged over 20 ms and over 2 x 2 taxels: enough to find shifts of a millimetre, in a tenth of the time.

POOL_S = 0.02
POOL_TAXELS = 2
SHARED_S = 0.2  #: Frames further apart than this have independent errors.
LEAST_REACH_MM = 10.0  #: Least length of a stroke, a run in one direction.
_CHUNK = 512


def stretches(time_s: FloatArray) -> IndexArray:
    """(n,) number of the stretch of `POOL_S` of each frame, counting stretches with frames only; times rise."""
    return np.cumsum(np.diff(_slot(time_s), prepend=_slot(time_s[:1])) != 0)


def thinning(times_s: Iterable[FloatArray], *, most: int) -> int:
    """Least n so that every nth stretch of scans with frames at these times gives about `most` averages or fewer."""
    return max(1, -(-sum(int(stretches(time)[-1]) + 1 for time in times_s if len(time)) // most))


def every_stretch(time_s: FloatArray, every: int) -> IndexArray:
    """Indices of the frames in every `every`-th of the `stretches`, at least one; the clock decides which is first."""
    number = stretches(time_s)
    chosen = (_slot(time_s[:1]) + number) % every == 0
    return np.flatnonzero(chosen if chosen.any() else number == 0)


def _slot(time_s: FloatArray) -> FloatArray:
    return np.asarray(np.floor(time_s / POOL_S))


class CoarseFrames(Record, eq=False, dict=True):
    """Frames of one scan, averaged over `POOL_S` and over blocks of taxels."""

    pressure: FloatArray
    """(m, k) array: Mean over a block of frames and a block of taxels, each frame over its own mean."""
    frames: IndexArray  #: (n,) int array: Indices in the scan of the frames that are averaged.
    first: IndexArray  #: (m,) int array: Index among them where each block of frames begins.
    block: IndexArray  #: (m,) int array: Number of the stretch of `SHARED_S` of each block of frames.
    taxels: IndexArray  #: (t,) int array: Flat indices of the good taxels.
    weight: FloatArray  #: (t, k) array: Share of each taxel in each block of taxels; columns add up to 1.
    row: IndexArray  #: (k,) int array: Number of the pair of the head's rows of each block of taxels.
    basis: FloatArray  #: (k, 6) array: Orthonormal level, two slopes and three curvatures over the head's blocks.

    @classmethod
    def of(cls, selection: SelectedFrames, frames: IndexArray) -> CoarseFrames:
        """Average frames of a scan, in the order of time; the few saturated readings count as their frame's mean."""
        scan = selection.scan
        weight, row, basis = _taxel_blocks(selection.good_taxels)
        first = np.flatnonzero(np.diff(stretches(scan.frames.time_s[frames]), prepend=-1))
        shared = np.floor(scan.frames.time_s[frames[first]] / SHARED_S)
        block = np.unique(shared, return_inverse=True)[1]
        pooled = np.empty((len(frames), weight.shape[1]))
        for part in chunks(len(frames), _CHUNK):
            chosen = frames[part]
            pressure, valid = selection.pressure_kpa(chosen)
            pressure /= selection.level_kpa[chosen, None]
            pooled[part] = (pressure if valid is None else np.where(valid, pressure, 1.0)) @ weight
        return cls(block_means(pooled, first), frames, first, block, selection.readout.taxels, weight, row, basis)

    @cached_property
    def varying(self) -> FloatArray:
        """(m, k) readings without the level and shape of each frame and the offset of each block of taxels."""
        return self.without_head(self.pressure)

    def without_head(self, values: FloatArray) -> FloatArray:
        """(m, k) values less their least-squares fit by a quadratic per frame and an offset per block of taxels."""
        return self.within_frames(values - values.mean(axis=0))  # both are projections, and commute

    def within_frames(self, values: FloatArray) -> FloatArray:
        """(m, k) values less their least-squares fit by a quadratic over the head in each frame."""
        return np.asarray(values - (values @ self.basis) @ self.basis.T)

    def places_mm(self, projection: Projection) -> FloatArray:
        """(m, k, 2) mean places of the blocks on the plane, from the projection of `frames`."""
        matrix = block_means(projection.matrix.reshape(len(projection), -1), self.first).reshape(-1, 2, 4)
        taxels = projection.taxels @ self.weight
        return np.asarray(np.einsum("mij,jk->mki", matrix, taxels) * projection.cell_mm)


def _taxel_blocks(good: BoolArray) -> tuple[FloatArray, IndexArray, FloatArray]:
    """Shares of the good taxels in blocks, each block's rows of the head, and polynomials over them."""
    row, column = np.nonzero(good)
    number = row // POOL_TAXELS * good.shape[1] + column // POOL_TAXELS
    blocks, member = np.unique(number, return_inverse=True)
    weight = np.zeros((len(row), len(blocks)))
    weight[np.arange(len(row)), member] = 1.0 / np.bincount(member)[member]
    s, t = ((place - place.mean()) / len(good) @ weight for place in (row.astype(float), column.astype(float)))
    terms = [np.ones_like(s), s, t, s * s, s * t, t * t][: len(blocks)]
    return weight, blocks // good.shape[1], np.linalg.qr(np.stack(terms, axis=1))[0]


def block_means(values: FloatArray, first: IndexArray) -> FloatArray:
    """(m, k) means of the rows of (n, k) values from each `first` up to the next."""
    counts = np.diff(np.append(first, len(values)))
    return np.asarray(np.add.reduceat(values, first, axis=0) / counts[:, None])


def stroke_starts(x_mm: FloatArray) -> list[int]:
    """Indices where runs in one direction begin along (n,) positions, and the last one's end; a turn ends a run."""
    ends, start, far = [0], 0, 0
    for i in range(len(x_mm)):
        rising = x_mm[far] >= x_mm[start]
        if (x_mm[i] - x_mm[far]) * (1 if rising else -1) >= 0:
            far = i
        elif abs(x_mm[far] - x_mm[i]) >= LEAST_REACH_MM / 2 and abs(x_mm[far] - x_mm[start]) >= LEAST_REACH_MM:
            ends.append(far)
            start, far = far, i
        elif abs(x_mm[far] - x_mm[start]) < min(LEAST_REACH_MM, abs(x_mm[i] - x_mm[start])):
            far = i  # it set out the other way
    return [*ends, len(x_mm)]


def strokes_along(x_mm: FloatArray) -> list[tuple[int, int, int]]:
    """First index, end and direction (1 towards +x, else -1) of each stroke along (n,) positions of the head."""
    ends = pairwise(stroke_starts(x_mm))
    return [(a, b, 1 if x_mm[min(b, len(x_mm) - 1)] >= x_mm[a] else -1) for a, b in ends if b > a]


def directions_along(x_mm: FloatArray) -> FloatArray:
    """(n,) direction of the stroke of each of (n,) positions."""
    directions = np.ones(len(x_mm))
    for start, stop, direction in strokes_along(x_mm):
        directions[start:stop] = direction
    return directions


# --- Poses of other makes: inverted, or of angles in another order, unit or sense.

INVERTED: Final = "the poses lead from the base to the sensor", "invert the 4 x 4 matrices, and import the scan again"
_UNITS: Final = {
    "in degrees": ("angles, degrees=True", 1.0),
    "in radians": ("angles", float(np.degrees(1.0))),
    "of the other sense": ("-angles, degrees=True", -1.0),
}
"""How angles are given, as scipy takes them, and the factor to those read as degrees."""


def other_paths(path: FramePoses) -> Iterator[tuple[tuple[str, str], FramePoses]]:
    """Words, way out and path of each other reading of poses: inverted, and of other angles than z, new y, new x."""
    back = path.rotation.swapaxes(1, 2)
    yield INVERTED, replace(path, position_mm=-np.einsum("mij,mj->mi", back, path.position_mm), rotation=back)
    r = path.rotation
    angles = (
        np.arctan2(r[:, 1, 0], r[:, 0, 0]),
        -np.arcsin(np.clip(r[:, 2, 0], -1, 1)),
        np.arctan2(r[:, 2, 1], r[:, 2, 2]),
    )
    for axes, (unit, (call, factor)) in product(permutations("xyz"), _UNITS.items()):
        first, second, third = (_turns(axis, factor * angle) for axis, angle in zip(axes, angles, strict=True))
        orders = {"".join(axes).upper(): first @ second @ third, "".join(axes): third @ second @ first}
        for order, rotation in orders.items():
            if (order, factor) in (("ZYX", 1.0), ("zyx", -1.0)):
                continue  # as stated, and the inverse rotation, which is a correction
            about = f"about {', the new '.join(axes)}" if order.isupper() else f"about the fixed {', '.join(axes)}"
            words = f"the rotations' angles (azimuth, elevation, roll) are {unit}, {about}"
            quaternions = f'Rotation.from_euler("{order}", {call}).as_quat(scalar_first=True)'
            way_out = f"import the scan again with quaternions of scipy's {quaternions}"
            yield (words, way_out), replace(path, rotation=rotation)


def _turns(axis: str, angle: FloatArray) -> FloatArray:
    """(m, 3, 3) rotations about one axis by (m,) angles."""
    wxyz = np.zeros((len(angle), 4))
    wxyz[:, 0], wxyz[:, "wxyz".index(axis)] = np.cos(angle / 2), np.sin(angle / 2)
    return rotation_from_quaternion(wxyz)


# --- Check of a tracker's rotation convention (order and sense) against the motion of the head.

DECLARED = "scalar first"
# Conventions of files for rotations, and the `CORRECTIONS` that turn each into ours: (w, x, y, z), from sensor to base.
CONVENTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    DECLARED: (),
    "scalar last": ("scalar-last",),
    "scalar first, of the inverse rotation": ("inverse-rotation",),
    "scalar last, of the inverse rotation": ("scalar-last", "inverse-rotation"),
}
# Least inner product of the mean normal of the face and the normal of the motion: a head slides along its face.
AGREEMENT = 0.9
# The least in any convention: strokes far round a curved breast turn the face by 45 degrees either way.
LEAST_AGREEMENT = 0.8
# Another convention is reported that agrees better by this and to more than that: by chance that is rare.
BETTER_BY = 0.005
NEARLY_WHOLE = 0.98
LEAST_SPREAD_MM = 3.0  #: A motion narrower than this across its longest axis (SD, mm) has no normal.


def corrected_quaternions(wxyz: FloatArray, corrections: Iterable[str]) -> FloatArray:
    """(n, 4) quaternions with the corrections of a convention made."""
    for name in corrections:
        wxyz = wxyz[:, [3, 0, 1, 2]] if name == "scalar-last" else wxyz * [1.0, -1.0, -1.0, -1.0]
    return wxyz


_QUARTER: Final = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def corrected(scan: Scan, corrections: Iterable[str]) -> Scan:
    """Scan with the named `CORRECTIONS` made; each reading keeps its taxel's calibration."""
    for name in corrections:
        scan = _with_correction(scan, name)
    return scan


def _with_correction(scan: Scan, name: str) -> Scan:
    head, lever = scan.head, scan.head.scanhead_from_tracker
    levers = {
        "lever-inverse": inverse(lever),
        "lever-none": np.eye(4),
        "quarter-turn": _QUARTER @ lever,
        "quarter-turn-back": _QUARTER.T @ lever,
    }
    if name in levers:
        return replace(scan, head=HeadGeometry(head.surface_mm, head.pitch_mm, levers[name]))
    if name in ("scalar-last", "inverse-rotation"):
        wxyz = corrected_quaternions(scan.poses.quaternion_wxyz, [name])
        return replace(scan, poses=replace(scan.poses, quaternion_wxyz=wxyz))
    frames, stated = scan.frames, scan.element_calibration
    gain, offset = (reordered(array, name) for array in (stated.gain_kpa_per_count, stated.offset_kpa))
    calibration = replace(stated, gain_kpa_per_count=gain, offset_kpa=offset)
    return replace(scan, frames=replace(frames, counts=reordered(frames.counts, name)), element_calibration=calibration)


def reordered(array: Any, name: str) -> Any:
    """(..., rows, columns) values in the order of taxels that a correction makes."""
    if name == "transposed":
        rows, columns = array.shape[-2:]
        return np.ascontiguousarray(array.reshape(*array.shape[:-2], columns, rows).swapaxes(-1, -2))
    axes = {"rows-reversed": (-2,), "columns-reversed": (-1,), "half-turn": (-2, -1)}[name]
    return np.ascontiguousarray(np.flip(array, axes))


_LEFT_HANDED: Final = (
    " (if the tracker's axes are left-handed, as in Unity, mirror its poses instead: else left and right change places)"
)


def import_again(corrections: Collection[str]) -> str:
    """Way out: the options of `import` that make the corrections, and of a mirrored array the other cause."""
    mirrored = ("rows-reversed" in corrections) != ("columns-reversed" in corrections)
    again = f"import the scan again with {' '.join(f'--correct {name}' for name in corrections)}"
    return again + _LEFT_HANDED if mirrored else again


def convention_agreement(selections: Sequence[SelectedFrames]) -> dict[str, float]:
    """Absolute inner product of the face's mean normal and the motion's normal, under each of `CONVENTIONS`.

    Empty where the motion has no normal: too few poses, or all along a line (record 0048).
    """
    parts = [(part, _poses_near_used(part)) for part in selections]
    if sum(len(poses) for _, poses in parts) < 3:
        return {}
    agreement = {name: _agreement(parts, corrections) for name, corrections in CONVENTIONS.items()}
    return agreement if np.isfinite(agreement[DECLARED]) else {}


def check_convention(selections: Sequence[SelectedFrames]) -> dict[str, float]:
    """Figures of a map on its rotations; those that cannot follow the declared convention are a `BadDataError`.

    ``normal_agreement`` is that of the rotations as declared; where another convention agrees better,
    ``other_convention`` is its number among `CONVENTIONS` and ``other_agreement`` its agreement. None where the motion
    has no normal. Limits and rates of errors are in record 0048.
    """
    agreement = convention_agreement(selections)
    if not agreement:
        return {}
    declared, best = agreement[DECLARED], max(agreement, key=agreement.__getitem__)
    if declared < LEAST_AGREEMENT or declared < AGREEMENT <= agreement[best]:
        if (curved := _agreement_on_a_sphere(selections)) >= NEARLY_WHOLE:
            return {"normal_agreement": curved}
        angle = np.degrees(np.arccos(min(1.0, declared)))
        raise BadDataError(f"the head's face and its motion are {angle:.0f} degrees apart", way_out=_way_out(agreement))
    figures = {"normal_agreement": declared}
    if agreement[best] > max(declared + BETTER_BY, NEARLY_WHOLE):
        figures |= {"other_convention": float(list(CONVENTIONS).index(best)), "other_agreement": agreement[best]}
    return figures


def convention_findings(quality: Mapping[str, float], others: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings on a map's rotations from its figures (`check_convention`); none where one of `others` says the same."""
    if "other_convention" in quality:
        other, agreement = list(CONVENTIONS)[int(quality["other_convention"])], quality["other_agreement"]
        options = [f"--correct {name}" for name in CONVENTIONS[other]]
        if any(one.kind == "wrong_arrangement" and all(map(one.remedy.__contains__, options)) for one in others):
            return ()
        text = "the tracker's rotations seem to be read the wrong way; size and place may be wrong"
        remedy = (
            f"the quaternions seem to be {other}: the head's face would follow its motion to {agreement:.3f} of 1, "
            f"against {quality['normal_agreement']:.3f} as they are told; check them; to change them, "
            f"{import_again(CONVENTIONS[other])}"
        )
        return (finding("wrong_rotations", text, remedy, "have the tracker's settings checked"),)
    if "normal_agreement" not in quality and "plane_rms_mm" in quality:
        text = "whether the tracker's rotations are read rightly does not show in this scan"
        remedy = "check that the quaternions are scalar first and from sensor to base"
        return (finding("rotations_unknown", text, remedy, "scan a phantom with a lump once and have it checked"),)
    return ()


def convention_way_out(selections: Sequence[SelectedFrames]) -> str:
    """Way out for a head that seems not to slide along its face: the convention under which it would."""
    return _way_out(convention_agreement(selections) or {DECLARED: 0.0})


_ANGLES_TOO: Final = "order and unit of angles"


def _way_out(agreement: dict[str, float]) -> str:
    best = max(agreement, key=agreement.__getitem__)
    if best == DECLARED or agreement[best] < AGREEMENT:
        return (
            f"check the quaternion order (scalar first), {_ANGLES_TOO}, the positions' axes, and scanhead_from_tracker"
        )
    seems = f"the quaternions seem to be {best} (agreement {agreement[best]:.2f} of 1)"
    return f"{seems}; {import_again(CONVENTIONS[best])}; or check {_ANGLES_TOO}"


def _poses_near_used(part: SelectedFrames) -> TrackerPoses:
    """Distinct poses near a used frame, where the head is on the skin."""
    poses = part.fresh
    used = part.scan.frames.time_s[part.used]
    near = np.zeros(len(poses), dtype=bool)
    if len(used):
        after = np.clip(np.searchsorted(used, poses.time_s), 0, len(used) - 1)
        away = np.minimum(np.abs(used[after] - poses.time_s), np.abs(used[np.maximum(after - 1, 0)] - poses.time_s))
        near = away <= MAX_POSE_GAP_MS / 1000.0
    return TrackerPoses(poses.time_s[near], poses.position_mm[near], poses.quaternion_wxyz[near])


def _agreement(parts: Sequence[tuple[SelectedFrames, TrackerPoses]], corrections: Iterable[str]) -> float:
    """Absolute inner product of the face's and the motion's normal; NaN where the apex moves along a line.

    The motion is that of the head's apex, and, since a head sinks as it slides over soft tissue, also without what is
    linear in the pressure; the better counts.
    """
    normals, path, level = _sliding(parts, corrections)
    agreements = [_along(normals.mean(axis=0), one) for one in (path, _without_sinking(path, level))]
    return float("nan") if np.isnan(agreements[0]) else float(np.nanmax(agreements))


def _agreement_on_a_sphere(selections: Sequence[SelectedFrames]) -> float:
    """Agreement as declared, less what of the motion goes with the face's own turn and with the pressure.

    Round a sphere the head sinks below a plane as its face turns: by more than lines lie apart on skin of 75 mm radius.
    Of 1,090 wrong conventions refused on a plane or on such skin none reaches `NEARLY_WHOLE` so.
    """
    normals, path, level = _sliding([(part, _poses_near_used(part)) for part in selections], ())
    mean = normals.mean(axis=0)
    causes = np.stack([np.sum((normals - mean) ** 2, axis=1), level], axis=1)
    causes -= causes.mean(axis=0)
    flat = path - causes @ np.linalg.lstsq(causes, path, rcond=None)[0]
    return float(abs(mean @ principal_axes(flat)[:, 0]) / np.linalg.norm(mean))


def _sliding(
    parts: Sequence[tuple[SelectedFrames, TrackerPoses]], corrections: Iterable[str]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n, 3) normals of the face, (n, 3) places of the head's apex, and (n,) mean pressures at the poses."""
    normals, places, levels = [], [], []
    for part, poses in parts:
        rotation = rotation_from_quaternion(corrected_quaternions(poses.quaternion_wxyz, corrections))
        lever = inverse(part.scan.head.scanhead_from_tracker)
        normals.append(rotation @ lever[:3, 2])
        places.append(poses.position_mm + rotation @ lever[:3, 3])
        known = np.isfinite(part.level_kpa)  # the mean pressure when the poses were taken
        at_frames = part.scan.frames.time_s[known], part.level_kpa[known]
        levels.append(np.interp(poses.time_s, *at_frames) if known.any() else np.zeros(len(poses)))
    return np.concatenate(normals), np.concatenate(places), np.concatenate(levels)


def _along(normal: FloatArray, places_mm: FloatArray) -> float:
    """Absolute inner product of `normal` with the normal of (n, 3) places; NaN where they lie along a line."""
    variances, axes = np.linalg.eigh(np.cov(places_mm.T))
    if not variances[1] > LEAST_SPREAD_MM**2:
        return float("nan")
    return float(abs(normal @ axes[:, 0]))


def _without_sinking(places_mm: FloatArray, level_kpa: FloatArray) -> FloatArray:
    """(n, 3) places less their regression on the pressure."""
    level = level_kpa - level_kpa.mean()
    slope = level @ (places_mm - places_mm.mean(axis=0)) / max(float(level @ level), 1e-9)
    return np.asarray(places_mm - level[:, None] * slope)
