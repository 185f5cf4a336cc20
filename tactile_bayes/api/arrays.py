"""A scan of arrays that Python holds, as `import` makes one of a file."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.arguments import PathLike, path_of, plain, takes
from tactile_bayes.api.maps import scan_given
from tactile_bayes.declarations import EXACT, replace, to_plain
from tactile_bayes.errors import UsageError
from tactile_bayes.files import imports
from tactile_bayes.files.arrays_layout import ArrayMap, Stated
from tactile_bayes.files.documents import with_session
from tactile_bayes.files.instrument import head_geometry
from tactile_bayes.files.named_arrays import Source, read_array_map
from tactile_bayes.files.npz import Arrays
from tactile_bayes.mapping.arrangement import corrected
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, Scan, TrackerPoses

_HEAD_SCHEMA = "tactile-bayes/head/1"


@takes(Stated)
def scan(
    frames: Any,
    time: Any = None,
    poses: Any = None,
    *,
    head: Any = None,
    calibration: Any = None,
    landmarks: Any = None,
    columns: PathLike | Mapping[str, Any] | None = None,
    correct: tuple[str, ...] = (),
    session: PathLike | None = None,
    **stated: Any,
) -> Scan:
    """Make a scan of arrays, or of a file of arrays, for `build_map`.

    Parameters
    ----------
    frames
        (n, rows, columns) readings, rows across the head; (n, rows x columns) is folded as the head is. Or the path of
        a file that `tactile-bayes import` reads; `time` and `poses` may then stand in it.
    time
        (n,) times of the frames, s, or `rate_hz` in its place.
    poses
        Of the tracker's sensor in its base: ``(time, matrices)`` with (m, 4, 4) homogeneous matrices, ``(time,
        position, quaternion)`` with mm and the scalar first, or (m, 8) numbers in that order. Or the path of a table of
        the tracker's, as `--poses` takes.
    head
        Path of a HEAD.json, what stands in it, or the head of another scan: ``pitch_mm``, ``surface_mm`` or ``rows``,
        ``columns`` and ``radius_mm``, and ``scanhead_from_tracker``.
    calibration
        Of raw counts: a path, the calibration of another scan, or gain (kPa a count) and offset (kPa).
    landmarks
        A path, the landmarks of another scan, or (2, 3) sternal notch and xiphoid in mm, with the nipple (3, 3).
    columns, correct, session
        As `--columns`, `--correct` and `--session` of `tactile-bayes import`.
    **stated
        As of `tactile_bayes.files.arrays_layout.Stated`: unit, saturation, rate_hz, frame_shape, time_unit...

    Returns
    -------
    Scan
        ``session["imported_as"]`` says what was guessed.

    Raises
    ------
    BadDataError
        Naming the array, its value and the way out.
    UsageError
        When an argument cannot be so.
    """
    columns = {} if columns is None else columns
    named = ArrayMap(**columns) if isinstance(columns, Mapping) else read_array_map(path_of(columns))
    given = replace(named, **{name: plain(value) for name, value in stated.items() if value is not None})
    beside = [_poses(poses, given), _head(head), _calibration(calibration), _landmarks(landmarks)]
    if isinstance(frames, str | Path):
        made, notes = imports.import_arrays(path_of(frames), given, beside)
    else:
        times = {} if time is None else {"frame_time_s": _array(time)}
        made, notes = imports.combined([Source({"frames": _array(frames), **times}), *beside], given)
    for note in notes:
        if note.startswith("CAUTION"):
            warnings.warn(note, stacklevel=4)
    return corrected(with_session(made, path_of(session)), correct)


def _array(given: Any) -> Any:
    """An array in which masked values are NaN, and dates are s since 1970."""
    if isinstance(given, np.ma.MaskedArray):
        return np.ma.filled(given.astype(np.float64), np.nan)
    array = np.asarray(given)
    if array.dtype.kind in "Mm":
        return array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64) / 1e9
    return array


def _poses(given: Any, stated: ArrayMap) -> Source:
    """Times, places and rotations, in the forms that `scan` takes."""
    if given is None:
        return Source({})
    if isinstance(given, str | Path):
        return imports.of_poses(path_of(given), stated)
    if isinstance(given, TrackerPoses):
        return Source(_named(given.time_s, given.position_mm, given.quaternion_wxyz))
    if isinstance(given, tuple | list) and len(given) == 3:
        return Source(_named(*given))
    if isinstance(given, tuple | list) and len(given) == 2:
        return Source({"pose_time_s": _array(given[0]), "pose_matrix": _array(given[1])})
    numbers = _array(given)
    if numbers.ndim != 2 or numbers.shape[1] != 8:
        raise UsageError(
            f"poses is {type(given).__name__} of shape {numbers.shape}; give (time, matrices), (time, position, "
            "quaternion) or (m, 8) numbers"
        )
    return Source(_named(numbers[:, 0], numbers[:, 1:4], numbers[:, 4:]))


def _named(time: Any, position: Any, quaternion: Any) -> Arrays:
    values = {"pose_time_s": time, "position_mm": position, "quaternion_wxyz": quaternion}
    return {name: _array(value) for name, value in values.items()}


def _head(given: Any) -> Source:
    if isinstance(given, Mapping):
        document = {"schema": _HEAD_SCHEMA, **to_plain(dict(given), digits=EXACT)}
        return imports.of_head(head_geometry(document, path=Path("head")))
    return _beside(given, HeadGeometry, imports.of_head, lambda other: other.head)


def _calibration(given: Any) -> Source:
    if isinstance(given, tuple | list) and len(given) == 2:
        return Source({"gain_kpa_per_count": _array(given[0]), "offset_kpa": _array(given[1])})
    return _beside(given, ElementCalibration, imports.of_calibration, lambda other: other.element_calibration)


def _landmarks(given: Any) -> Source:
    points = None if given is None or isinstance(given, str | Path | Landmarks | Scan) else _array(given)
    if points is not None and points.shape in ((2, 3), (3, 3)):
        return Source({"landmarks_mm": points[:2], **({"nipple_mm": points[2]} if len(points) == 3 else {})})
    return _beside(given, Landmarks, imports.of_landmarks, lambda other: other.landmarks)


def _beside(given: Any, kind: type, made: Callable[[Any], Source], part: Callable[[Scan], Any]) -> Source:
    """What stands beside the frames: nothing, a path, a record, or that of another scan."""
    if given is None:
        return Source({})
    if isinstance(given, str | Path):
        return made(path_of(given))
    return made(given if isinstance(given, kind) else part(scan_given(given)))
