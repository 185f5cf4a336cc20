"""Small valid files of each format that the program reads, and its readers: where the fuzzing of readers begins."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

PACKAGE = Path(__file__).resolve().parents[2] / "tactile_bayes"
MAPPING = """patient = "record_id"
not_detected = ["NV"]
[excision]
size = "ex_mm"
[[reading]]
modality = "tactile"
size = "map1"
low = "map1_low"
high = "map1_high"
probability = 0.9
"""
WIDE = "record_id,ex_mm,map1,map1_low,map1_high\nP1,10,11,9,14\nP2,20,NV,,\n"
PROTOCOL = (
    '[analysis]\nintervals = "bca"\nresamples = 999\nseed = 3\nerror_ratio = 1.5\n[promise]\ntext = "all masses"\n'
)
SETTINGS = (
    'amplitude_sd = 0.5\nwidth_median_mm = 5.0\nnoise = "field"\nfield_cosines = 20\ncheckpoint = "state.npz"\n'
    'background = "free"\nfit_radius_mm = 20.0\nrotation = "on"\nmax_steps = 2000\n'
)


@dataclass(frozen=True)
class Format:
    """One format: how to make valid files of it, and what reads them.

    Parameters
    ----------
    suffix
        Of the files.
    seeds
        Makes valid files; called with a folder for what must be written on the way.
    readers
        Each is called with the path of every file.
    """

    suffix: str
    seeds: Callable[[Path], Sequence[bytes]]
    readers: Sequence[Callable[[Path], object]]


def _scan_arrays(frames: int) -> dict[str, np.ndarray[Any, Any]]:
    rng = np.random.default_rng(frames)
    rows, columns = 4, 5
    x, y = np.meshgrid(np.arange(rows) * 2.0, np.arange(columns) * 2.0, indexing="ij")
    return {
        "counts": rng.integers(0, 4000, (frames, rows, columns), dtype=np.uint16),
        "frame_time_s": np.arange(frames) / 50.0,
        "position_mm": np.stack([np.linspace(0, 40, frames), np.zeros(frames), rng.normal(0, 1, frames)], axis=1),
        "quaternion_wxyz": np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
        "pose_time_s": np.arange(frames) / 50.0,
        "gain_kpa_per_count": np.full((rows, columns), 0.01),
        "offset_kpa": np.zeros((rows, columns)),
        "pitch_mm": np.array(2.0),
        "array_from_tracker": np.eye(4),
        "head_surface_mm": np.stack([x, y, np.zeros_like(x)], axis=-1),
        "landmarks_mm": np.array([[0.0, 90.0, 0.0], [0.0, -90.0, 0.0]]),
    }


def _npz(arrays: dict[str, np.ndarray[Any, Any]], *, packed: bool = False) -> bytes:
    buffer = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(buffer, **arrays)
    return buffer.getvalue()


def _scan(folder: Path, frames: int) -> bytes:
    from tactile_bayes.files.imports import read_arrays
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.files.scan_mcap import write_scan

    (folder / "a.npz").write_bytes(_npz(_scan_arrays(frames)))
    write_scan(folder / "a.mcap", read_arrays(folder / "a.npz"), provenance=Provenance("fuzz", {}), force=True)
    return (folder / "a.mcap").read_bytes()


def _grid() -> np.ndarray[Any, np.dtype[np.float64]]:
    axis = np.arange(-20.0, 21.0)
    bump = 1 + 0.4 * np.exp(-(axis[None, :] ** 2 + axis[:, None] ** 2) / 72)
    return np.asarray(bump + np.random.default_rng(1).normal(0, 0.01, bump.shape))


def _csv_grid() -> str:
    return "\n".join(",".join(f"{value:.4f}" for value in row) for row in _grid()[::4, ::4]) + "\n"


def _tables() -> list[bytes]:
    sizes = b"d_mm,depth_ratio,amplitude,sigma_x_mm\n10,1.0,0.6,3.5\n15,1.5,0.4,5.0\n20,2.0,0.2,7.5\n"
    return [(PACKAGE / "demo" / name).read_bytes() for name in ("trial.csv", "excision.csv")] + [sizes]


def _image(kind: str, mode: str, **options: Any) -> bytes:
    from PIL import Image

    levels = np.clip(100 * _grid()[:16, :12], 0, 255)
    pixels = levels.astype({"I;16": np.uint16, "F": np.float32}.get(mode, np.uint8))
    image = Image.fromarray(np.stack([pixels] * 3, axis=-1) if mode == "RGB" else pixels)
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def _tiffs() -> list[bytes]:
    plain = [_image("TIFF", mode) for mode in ("L", "I;16", "F", "RGB")]
    packings = ("tiff_lzw", "packbits", "tiff_adobe_deflate", "tiff_deflate")
    return plain + [_image("TIFF", "L", compression=packing) for packing in packings]


def _tomls() -> list[bytes]:
    scenes = [(PACKAGE / "demo" / "scene.toml").read_bytes()]
    return [SETTINGS.encode(), PROTOCOL.encode(), MAPPING.encode(), *scenes]


def _jsons(folder: Path) -> list[bytes]:
    """Calibrations of both forms, what `record` reads, and a report."""
    _map(folder)
    words = ["estimate", str(folder / "m.nc"), "--method", "laplace", "--json"]
    report = subprocess.run([sys.executable, "-m", "tactile_bayes", *words], capture_output=True).stdout
    (folder / "s.csv").write_bytes(
        b"d_mm,depth_ratio,amplitude,sigma_x_mm\n"
        + b"".join(
            f"{d},{h},{0.6 * h**-2:.4f},{0.35 * d * h**0.6 * wobble:.4f}\n".encode()
            for d in (10, 15, 20)
            for h, wobble in ((0.8, 1.02), (1.0, 0.99), (1.5, 1.01))
        )
    )
    words = ["calibrate", "size", str(folder / "s.csv"), "-o", str(folder / "eq6.json"), "--force"]
    subprocess.run([sys.executable, "-m", "tactile_bayes", *words], check=True, capture_output=True)
    eq6 = json.loads((folder / "eq6.json").read_text())
    for axis in ("x", "y"):
        eq6[axis]["draws"] = eq6[axis]["draws"][:20]  # a small file is mutated where it matters
    arrays = _scan_arrays(2)
    head = {
        "schema": "tactile-bayes/head/1",
        "pitch_mm": 2.0,
        "scanhead_from_tracker": np.eye(4).tolist(),
        "surface_mm": arrays["head_surface_mm"].tolist(),
    }
    array = {
        "schema": "tactile-bayes/array-calibration/1",
        "head_id": "H1",
        "date": "2026-01-02",
        "saturation_count": 4095,
        "gain_kpa_per_count": arrays["gain_kpa_per_count"].tolist(),
        "offset_kpa": arrays["offset_kpa"].tolist(),
        "quality": {},
    }
    points = {
        "schema": "tactile-bayes/landmarks/1",
        "sternal_notch_mm": [0.0, 90.0, 0.0],
        "xiphoid_mm": [0.0, -90.0, 0.0],
    }
    repeat = {"exams": ["P.v1.m1.r1", "P.v1.m1.r2"], "log_size": [2.6, 2.7], "map_sd": [0.03, 0.02], "by_chance": 0.4}
    site = {
        "schema": "tactile-bayes/repeatability/1",
        "research_use": "Research use only: not a diagnostic device.",
        **{"between_map_sd": 0.08, "log_sd": 0.2, "median": 0.078, "low": 0.06, "high": 0.11, "probability": 0.95},
        **{"masses": 3, "maps": 6, "outlying": ["M1"], "left_out": []},
        "calibration": {"name": "solid", "sha256": "0" * 64, "normalise": "gain"},
        "half_width": {"as_estimated": 0.2, "with_it": 0.3},
        "repeats": [{"name": f"M{i}", **repeat} for i in range(3)],
        "provenance": {"inputs": [{"role": "draws_1", "sha256": "0" * 64}]},
    }
    made = [json.dumps(document).encode() for document in (eq6, head, array, points, site)]
    return [(PACKAGE / "calibrations" / "solid.json").read_bytes(), report, *made]


def _map(folder: Path) -> bytes:
    from tactile_bayes.files.arrays_layout import GridOptions
    from tactile_bayes.files.grids import import_grid
    from tactile_bayes.files.map_nc import write_map
    from tactile_bayes.files.provenance import Provenance

    (folder / "m.npz").write_bytes(_npz({"mean": _grid(), "spacing_mm": np.array(1.0)}))
    tactile_map, _ = import_grid(folder / "m.npz", GridOptions(normalise="mean"))
    write_map(folder / "m.nc", tactile_map, provenance=Provenance("fuzz", {}), force=True)
    return (folder / "m.nc").read_bytes()


def _posterior() -> bytes:
    from tactile_bayes.files.netcdf import Contents, Variable, grouped_netcdf_bytes
    from tactile_bayes.files.posterior_nc import POSTERIOR_SCHEMA as SCHEMA

    sizes = np.random.default_rng(2).lognormal(2.5, 0.1, (1, 60))
    names = ("d_x_mm", "d_y_mm", "max_size_mm", "min_size_mm", "amplitude")
    variables = {name: Variable(sizes, ("chain", "draw"), {}) for name in names}
    attributes = {"schema": SCHEMA, "method": "importance", "diagnostics": "{}", "provenance": '{"seed": 1}'}
    return grouped_netcdf_bytes({"posterior": Contents(variables, attributes)})


def _checkpoint(folder: Path) -> bytes:
    from tactile_bayes.files.npz import CheckpointFile
    from tactile_bayes.inference.ensemble import ChainState

    rng = np.random.default_rng(3)
    state = ChainState(
        chain=rng.normal(size=(1, 5, 4, 3)),
        log_density=rng.normal(size=(1, 4)),
        accepted=rng.normal(size=1),
        twister=rng.integers(0, 2**32, (1, 624), dtype=np.uint32),
        cursor=rng.normal(size=(1, 3)),
    )
    CheckpointFile(folder / "c.npz").save("key", state)
    return (folder / "c.npz").read_bytes()


def _store(folder: Path) -> bytes:
    from tactile_bayes.batch import open_store

    with open_store(folder / "b.jsonl", settings={"seed": 1}) as store:
        for number in range(6):
            store.add(f"item {number}", {"size_mm": 12.5 + number, "note": "ü"})
    return (folder / "b.jsonl").read_bytes()


def _read_scan(path: Path) -> object:
    from tactile_bayes.files.scan_mcap import read_scan_report

    return read_scan_report(path)


def _describe(path: Path) -> object:
    from tactile_bayes.actions.show import describe, fact_lines
    from tactile_bayes.files.documents import dump_json

    found = describe(path)
    return dump_json(found), list(fact_lines(found))


def _read_arrays(path: Path) -> object:
    from tactile_bayes.files.imports import read_arrays

    return read_arrays(path)


def _read_frames(path: Path) -> object:
    from tactile_bayes.files.arrays_layout import ArrayMap
    from tactile_bayes.files.imports import head_source, import_arrays, pose_source
    from tactile_bayes.scans import HeadGeometry

    y, x = np.meshgrid(2.0 * np.arange(5), 2.0 * np.arange(4))
    head = HeadGeometry(np.stack([x, y, 0 * x], axis=-1), 2.0, np.eye(4))
    return import_arrays(path, ArrayMap(unit="kPa"), [head_source(head), pose_source(path, ArrayMap())])


def _mat(arrays: Mapping[str, Any], *, packed: bool) -> bytes:
    import scipy.io

    stream = io.BytesIO()
    scipy.io.savemat(stream, dict(arrays), do_compression=packed)  # type: ignore[arg-type]
    return stream.getvalue()


def _hdf5(arrays: Mapping[str, Any]) -> bytes:
    import h5py

    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        for name, one in arrays.items():
            file.create_dataset(name, data=one, **({"compression": "gzip"} if np.ndim(one) else {}))
    return stream.getvalue()


def _frames_and_poses() -> bytes:
    """One table in which a reader of frames and one of poses find something each."""
    names = "time (ms),status,x,y,z,qw,qx,qy,qz," + ",".join(f"S{i}" for i in range(20))
    rows = [f"{5 * i}.0,OK,{i},2,3,1,0,0,0," + ",".join(f"{9 + i / 10}" for _ in range(20)) for i in range(9)]
    return "\n".join(["Units: kPa", "", names, *rows, ""]).encode()


def _metafile() -> bytes:
    head = ["ObjectType = Image", "CompressedData = False", "DimSize = 5 4 3", "ElementType = MET_UCHAR"]
    for i in range(3):
        head += [f"Seq_Frame{i:04d}_ProbeToTrackerTransform = 1 0 0 {i} 0 1 0 0 0 0 1 0 0 0 0 1"]
        head += [f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus = OK", f"Seq_Frame{i:04d}_Timestamp = 0.{i}"]
    return "\n".join([*head, "ElementDataFile = LOCAL\n"]).encode() + bytes(9 + i % 3 for i in range(60))


def _read_grid(path: Path) -> object:
    from tactile_bayes.files.arrays_layout import GridOptions
    from tactile_bayes.files.grids import import_grid

    return import_grid(path, GridOptions(spacing_mm=None if path.suffix == ".npz" else 1.0))


def _read_tables(path: Path) -> object:
    from tactile_bayes.files.tables import read_table

    return _first(
        [lambda name=name: read_table(path, f"{name}.table.json") for name in ("trial", "excision", "size_table")]
    )


def _read_wide(path: Path) -> object:
    from tactile_bayes.files.column_map import read_mapping, read_wide, read_wide_excision

    named = path.with_name("mapping.toml")
    if not named.exists():
        named.write_text(MAPPING)
    mapping = read_mapping(named)
    return _first(
        [
            lambda: read_wide(path, mapping, mapping.reading),
            lambda: read_wide_excision(path, mapping, mapping.excision),
        ]
    )


def _read_tomls(path: Path) -> object:
    from tactile_bayes.api.settings import read_settings
    from tactile_bayes.files.column_map import read_mapping
    from tactile_bayes.files.documents import read_protocol
    from tactile_bayes.files.instrument import read_scene

    return _first([lambda read=read: read(path) for read in (read_settings, read_protocol, read_mapping, read_scene)])


def _read_jsons(path: Path) -> object:
    from tactile_bayes.files.estimate_json import read_stated_size
    from tactile_bayes.files.instrument import read_array_calibration, read_head_geometry, read_landmarks
    from tactile_bayes.files.size_json import read_repeatability, read_size_calibration

    readers = (
        read_size_calibration, read_stated_size, read_head_geometry, read_array_calibration, read_landmarks,
        read_repeatability,
    )  # fmt: skip
    return _first([lambda read=read: read(path) for read in readers])


def _first(readers: Sequence[Callable[[], object]]) -> object:
    """What the first reader that accepts the file makes of it; all are asked, and the last refusal goes up."""
    from tactile_bayes.errors import TactileBayesError

    refusal: TactileBayesError | None = None
    found: list[object] = []
    for read in readers:
        try:
            found.append(read())
        except TactileBayesError as error:
            refusal = error
    if not found and refusal is not None:
        raise refusal
    return found[0]


def _read_map(path: Path) -> object:
    from tactile_bayes.files.map_nc import read_map

    return read_map(path)


def _read_size(path: Path) -> object:
    from tactile_bayes.files.estimate_json import read_stated_size

    return read_stated_size(path)


def _read_checkpoint(path: Path) -> object:
    from tactile_bayes.files.npz import CheckpointFile

    return CheckpointFile(path).load("key")


def _read_store(path: Path) -> object:
    from tactile_bayes.batch import open_store

    copy = path.with_suffix(".copy")
    shutil.copyfile(path, copy)  # opening a store may shorten it
    with open_store(copy, settings={"seed": 1}) as store:
        return dict(store)


FORMATS = {
    "mcap scan": Format(".mcap", lambda folder: [_scan(folder, 40), _scan(folder, 7)], [_read_scan, _describe]),
    "npz scan": Format(".npz", lambda _: [_npz(_scan_arrays(5)), _npz(_scan_arrays(20), packed=True)], [_read_arrays]),
    "mat scan": Format(
        ".mat", lambda _: [_mat(_scan_arrays(5), packed=packed) for packed in (False, True)], [_read_arrays]
    ),
    "hdf5 scan": Format(".h5", lambda _: [_hdf5(_scan_arrays(5))], [_read_arrays]),
    "frames and poses": Format(".csv", lambda _: [_frames_and_poses()], [_read_frames]),
    "metafile": Format(".mha", lambda _: [_metafile()], [_read_frames]),
    "npz grid": Format(".npz", lambda _: [_npz({"mean": _grid(), "spacing_mm": np.array(1.0)})], [_read_grid]),
    "csv grid": Format(".csv", lambda _: [_csv_grid().encode()], [_read_grid]),
    "csv table": Format(".csv", lambda _: _tables(), [_read_tables, _describe]),
    "csv wide": Format(".csv", lambda _: [WIDE.encode()], [_read_wide]),
    "png": Format(".png", lambda _: [_image("PNG", mode) for mode in ("L", "I;16", "RGB")], [_read_grid]),
    "tiff": Format(".tif", lambda _: _tiffs(), [_read_grid]),
    "pgm": Format(".pgm", lambda _: [_image("PPM", "L"), b"P2\n3 2\n255\n1 2 3\n4 5 6\n"], [_read_grid]),
    "toml": Format(".toml", lambda _: _tomls(), [_read_tomls]),
    "json": Format(".json", _jsons, [_read_jsons, _describe]),
    "netcdf map": Format(".nc", lambda folder: [_map(folder)], [_read_map, _describe]),
    "netcdf posterior": Format(".nc", lambda _: [_posterior()], [_read_size, _describe]),
    "checkpoint": Format(".npz", lambda folder: [_checkpoint(folder)], [_read_checkpoint]),
    "batch store": Format(".jsonl", lambda folder: [_store(folder)], [_read_store]),
}
