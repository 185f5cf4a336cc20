"""The nipple while recording: its key, the live view's axes, and the age of the array's calibration."""

from __future__ import annotations

from datetime import date
from types import SimpleNamespace

import numpy as np
import pytest
from test_orientation import scan_of

from tactile_bayes.actions.record import Keys, calibration_age
from tactile_bayes.hardware.live import LiveMap


@pytest.mark.parametrize(("key", "name"), [("n", "sternal_notch"), ("x", "xiphoid"), ("p", "nipple")])
def test_a_key_touches_its_landmark(key: str, name: str) -> None:
    recorder = SimpleNamespace(touch=None)
    Keys(recorder, np.eye(4), wait=False, drawn=False)._press(key)
    assert recorder.touch.name == name


@pytest.mark.parametrize(
    ("names", "axes"),
    [(("sternal_notch", "nipple"), False), (("sternal_notch", "nipple", "xiphoid"), True)],
)
def test_the_live_view_has_the_patients_axes_from_notch_and_xiphoid_alone(names: tuple[str, ...], axes: bool) -> None:
    scan = scan_of(70)
    live = LiveMap(scan.head, scan.element_calibration)
    points = {**scan.landmarks.points(), "nipple": np.array([1.0, 2.0, 3.0])}
    seen: list = [("landmark", name, tuple(points[name])) for name in names]
    for i, (counts, time) in enumerate(zip(scan.frames.counts, scan.frames.time_s, strict=True)):
        turn, place = scan.poses.quaternion_wxyz[i], scan.poses.position_mm[i]
        seen += [("pose", round(time * 1e9), place, turn), ("frame", round(time * 1e9), 1, counts)]
    live.take(seen)
    assert (live.state().tactile_map.patient_from_plane is not None) is axes


def test_a_recording_tells_the_age_of_its_array_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "tactile_bayes.actions.record.read_array_calibration",
        lambda _: SimpleNamespace(day=date(2026, 1, 30), head_id="7"),
    )
    given = {"uncalibrated": False, "accept_calibration": False, "calibration_days": 5.0}
    day = {"head_id": "7", "today": date(2026, 2, 2)}
    request = SimpleNamespace(array_calibration="array.json", **given)
    assert calibration_age(request, **day) == {"array_calibration_days": "3"}
    assert calibration_age(SimpleNamespace(array_calibration=None, **given), **day) == {}
