"""The nipple while recording: its key, the live view's axes, and the age of the array's calibration."""

from __future__ import annotations

from datetime import date
from types import SimpleNamespace

import numpy as np
import pytest
from test_orientation import scan_of

from tactile_bayes.actions.record import Keys, calibration_age, calibration_for
from tactile_bayes.declarations import replace
from tactile_bayes.errors import DeviceError, UsageError
from tactile_bayes.hardware.live import LiveMap
from tactile_bayes.hardware.readings import HelloReading


@pytest.mark.parametrize(("key", "name"), [("n", "sternal_notch"), ("x", "xiphoid"), ("p", "nipple")])
def test_a_key_touches_its_landmark(key: str, name: str) -> None:
    begun: list = []
    recorder = SimpleNamespace(begin_touch=begun.append, tracker="a line")
    Keys(recorder, np.eye(4), wait=False, drawn=False)._press(key)
    assert [one.name for one in begun] == [name]


def test_a_landmark_without_a_tracker_is_answered(capsys: pytest.CaptureFixture[str]) -> None:
    """The key did nothing."""
    recorder = SimpleNamespace(touch=None, tracker=None)
    Keys(recorder, np.eye(4), wait=False, drawn=False)._press("n")
    assert (recorder.touch, capsys.readouterr().err) == (None, "no landmark without a tracker\n")


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
    with pytest.raises(UsageError, match="is of 2026-01-30, which is to come"):  # it was -4 days old
        calibration_age(request, head_id="7", today=date(2026, 1, 26))


def test_readings_at_the_heads_own_full_scale_carry_no_pressure() -> None:
    """A head of 10 bits was taken for one of 12: its saturated readings counted as pressure."""
    hello = HelloReading("7", 2, 3, 1023, 100.0)
    request = SimpleNamespace(head_url="/dev/x", like="last.mcap", accept_calibration=False)
    nominal = calibration_for(hello, None, request)
    assert nominal.saturation_count == 1023
    assert np.isnan(nominal.to_kpa(np.full((1, 2, 3), 1023, np.uint16))).all()
    assert calibration_for(hello, nominal, request) is nominal
    twelve_bits = replace(nominal, saturation_count=4095)
    with pytest.raises(
        UsageError, match="saturated at 1023 counts, the calibration given at 4095; calibrate this head"
    ):
        calibration_for(hello, twelve_bits, request)
    with pytest.raises(UsageError, match=r"is '7', last.mcap was recorded with '6'"):  # it was taken without a word
        calibration_for(hello, nominal, request, owner="6")
    request.accept_calibration = True
    assert calibration_for(hello, twelve_bits, request, owner="6") is twelve_bits
    with pytest.raises(DeviceError, match="saturation count 0"):
        calibration_for(hello._replace(saturation_count=0), None, request)
