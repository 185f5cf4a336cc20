"""Summary of a scan file, counted while reading it from front to back; no message is kept."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.mcap_records import McapRecords
from tactile_bayes.files.scan_mcap import (
    LANDMARK_NAMES,
    NIPPLE,
    SCAN_SCHEMA,
    file_findings,
    json_attachment,
    json_object,
    message_times,
    scan_records,
)
from tactile_bayes.files.scan_parts import head_from_document
from tactile_bayes.findings import finding_lines
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.overlap import Span, with_times


def summarise_scan(path: Path) -> dict[str, Any]:
    """Summarise frames, poses, duration, losses, session and provenance; memory grows by one time per message.

    Raises
    ------
    BadDataError
        As `read_scan_report`, but for messages that hold what they must not: nothing looks into them.
    """
    records = scan_records(path, keep=())
    try:
        return _summary(records)
    except BadDataError as error:
        raise error.at(path) from None


def _summary(records: McapRecords) -> dict[str, Any]:
    head = head_from_document(json_attachment(records, "head.json"))
    time_s = message_times(records.messages("/pressure", schema="foxglove.Grid"), topic="/pressure")
    pose_s = message_times(records.messages("/pose", schema="foxglove.PoseInFrame"), topic="/pose")
    account = records.metadata.get("recording", {})
    span_s = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    topics = records.topic_counts()
    return {
        "schema": SCAN_SCHEMA,
        "kind": "scan",
        "complete": records.finished and not records.lost,
        "findings": finding_lines(with_times(file_findings(records), Span.of(time_s), Span.of(pose_s))),
        "frames": len(time_s),
        "taxels": list(head.shape),
        "poses": len(pose_s),
        "duration_s": span_s,
        "frame_rate_hz": (len(time_s) - 1) / span_s if span_s > 0 else None,
        **_recording(account, topics, time_s),
        "landmarks": all(_touched(records, name) for name in LANDMARK_NAMES),
        "nipple": _touched(records, NIPPLE),
        "units": {"counts": "raw, 0 to saturation", "pressure": "kPa", "position": "mm", "time": "s"},
        "session": dict(records.metadata.get("session", {})),
        "provenance": json_object(records.metadata.get("provenance", {}).get("json", "{}"), name="provenance"),
    }


def _touched(records: McapRecords, name: str) -> bool:
    return len(records.messages("/landmark", schema="foxglove.PoseInFrame", name=name)) > 0


def _recording(account: Mapping[str, str], topics: Mapping[str, int], time_s: FloatArray) -> dict[str, Any]:
    """Losses: gaps between the frames' times, and the recorder's account if the file has one."""
    steps = np.diff(time_s)
    period = float(np.median(steps)) if len(steps) else 0.0
    missing = int(np.clip(np.rint(steps / period) - 1, 0, None).sum()) if period > 0 else 0
    names = ("frames_lost", "head_dropped", "poses_repeated", "poses_flagged", "overrun_bytes", "ended_by", "fault")
    told = {name: account[name] for name in names if account.get(name)}
    return {"frames_missing": missing, "notes": topics.get("/log", 0)} | ({"recording": told} if told else {})
