"""How fast a head's bytes are taken: ``python -m benchmarks.record [--json OUT]``.

Bytes a second of one core through the head's parser and through the whole recorder, against real time; time and size
of the scan file. Hours, busy machines and kills are in tests/endurance/recording.py.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import RecordingWriter, create_exclusive, read_scan, write_scan
from tactile_bayes.forward.scene import Lump, Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.hardware.emulated import EmulatedHead
from tactile_bayes.hardware.head import HeadParser, encode_hello
from tactile_bayes.hardware.recorder import DeviceLine, Recorder
from tactile_bayes.scans import Scan

RATE_HZ = 200.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures, write JSON when asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.record", description=__doc__)
    parser.add_argument("--duration", type=float, default=60.0, help="of the scan in s (60)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures as JSON")
    options = parser.parse_args(arguments)
    scene = Scene(
        seed=5,
        duration_s=options.duration,
        frame_rate_hz=RATE_HZ,
        pose_rate_hz=120.0,
        lumps=(Lump(amplitude=0.3, d_mm=15.0),),
    )
    with tempfile.TemporaryDirectory() as name:
        rows = throughput(Path(name), simulate(scene, rng=np.random.default_rng(scene.seed)).scan)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    return 0


def throughput(folder: Path, data: Scan) -> dict[str, dict[str, float]]:
    """How much one core could take, in bytes a second and in times real time."""
    seconds = len(data.frames) / RATE_HZ
    wire = wire_of(data)
    pieces = [wire[i : i + 4000] for i in range(0, len(wire), 4000)]
    parser = HeadParser()
    parsing = cpu_of(lambda: [parser.feed(piece) for piece in pieces])
    recording = cpu_of(lambda: record_pieces(data, pieces, folder / "recorded.mcap"))
    writing = cpu_of(
        lambda: write_scan(folder / "written.mcap", data, provenance=Provenance("benchmark", {}), force=True)
    )
    reading = cpu_of(lambda: read_scan(folder / "written.mcap"))
    size = (folder / "written.mcap").stat().st_size
    rows = {
        "head parser": rate(parsing, len(wire), seconds),
        "recorder (parse, serialise, compress, write)": rate(recording, len(wire), seconds),
        "MCAP write": {"cpu_s": round(writing, 3), "times_real_time": round(seconds / writing, 1)},
        "MCAP read": {"cpu_s": round(reading, 3), "times_real_time": round(seconds / reading, 1)},
        "MCAP size": {"bytes": size, "bytes_per_frame": round(size / len(data.frames), 1), "raw_bytes_per_frame": 832},
    }
    for name, row in rows.items():
        print(f"{name:<46}" + "  ".join(f"{key} {value:,}" for key, value in row.items()))
    return rows


def rate(cpu_s: float, size: int, seconds: float) -> dict[str, float]:
    """Bytes a second of one core, and how many heads that would be."""
    return {"megabytes_per_s": round(size / cpu_s / 1e6, 2), "times_real_time": round(seconds / cpu_s, 1)}


def cpu_of(work: Callable[[], object]) -> float:
    """CPU seconds of this process, least of three."""
    costs = []
    for _ in range(3):
        begun = time.process_time()
        work()
        costs.append(time.process_time() - begun)
    return min(costs)


def wire_of(data: Scan) -> bytes:
    """A scan as its head would send it."""
    head = EmulatedHead(data)
    return encode_hello(head.hello()) + b"".join(head.record(i) for i in range(len(data.frames)))


def record_pieces(data: Scan, pieces: list[bytes], path: Path) -> None:
    """What the recorder does with them, but for waiting."""
    with create_exclusive(path, force=True) as stream:
        writer = RecordingWriter(
            stream,
            head=data.head,
            element_calibration=data.element_calibration,
            session={"source": "benchmark"},
            provenance=Provenance("benchmark", {}),
        )
        line = DeviceLine("head", None, None, HeadParser(), b"", b"")  # type: ignore[arg-type]
        recorder = Recorder(line, None, writer)
        recorder.recording = True
        for number, piece in enumerate(pieces):
            for reading in line.parser.feed(piece):
                recorder._process(line, reading, time.monotonic_ns())
            if number % 9 == 0:  # every 0.2 s of real time
                writer.flush()
        writer.close({})


if __name__ == "__main__":
    sys.exit(main())
