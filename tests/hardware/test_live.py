"""The live view: what it sees, what it draws, who may look."""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from emulated_devices import head_and_tracker, short_scan
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from tactile_bayes.actions.live_view import RiseRotation, live_estimate, live_line, live_text
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.hardware.live import (
    Feed,
    LiveMap,
    LiveServer,
    LiveState,
    grey_levels,
    page_state,
    parse_address,
    read_feed,
)
from tactile_bayes.hardware.readings import PoseReading
from tactile_bayes.hardware.recorder import RecordingReport
from tactile_bayes.mapping.accumulate import MapAccumulator
from tactile_bayes.mapping.cells import distinct_poses, poses_at
from tactile_bayes.shell import has_styles


@pytest.fixture(scope="module")
def scan():
    return short_scan(1.0)


@pytest.fixture
def pipe():
    theirs, ours = os.pipe()
    return read_feed(theirs, 0.0), Feed(ours)


def pose_of(scan, index: int) -> PoseReading:
    position, turn = scan.poses.position_mm[index], scan.poses.quaternion_wxyz[index]
    return PoseReading(tuple(position.tolist()), tuple(turn.tolist()))


def seen_of(scan) -> list:
    """A scan as a view would see it, in order of time."""
    frames = [
        ("frame", round(time * 1e9), 1, counts)
        for counts, time in zip(scan.frames.counts, scan.frames.time_s, strict=True)
    ]
    poses = [("pose", round(scan.poses.time_s[i] * 1e9), *pose_of(scan, i)[:2]) for i in range(len(scan.poses))]
    return sorted([*frames, *poses], key=lambda one: one[1])


@pytest.fixture(scope="module")
def state(scan) -> LiveState:
    live = LiveMap(scan.head, scan.element_calibration)
    seen = seen_of(scan)
    for start in range(0, len(seen), 25):
        live.take(seen[start : start + 25])
    live.take([("report", {"frames": 200, "frames_lost": 3, "poses": 120, "duration_s": 0.995})])
    return live.state(size="largest size 15.0 mm")


def test_records_pass_through_the_pipe_unchanged(scan, pipe):
    reader, feed = pipe
    feed.frame(scan.frames.counts[3], 15_000_000)
    feed.pose(pose_of(scan, 2), 16_666_667)
    feed.landmark("xiphoid", np.array([1.0, -2.5, 3.0]))
    feed.report(RecordingReport(frames=4, unseen="out of volume", other_tools="x" * 9999))
    frame, pose, landmark, report = next(reader)
    assert landmark == ("landmark", "xiphoid", [1.0, -2.5, 3.0])
    np.testing.assert_array_equal(frame[-1], scan.frames.counts[3])
    assert (frame[1], pose[1]) == (15_000_000, 16_666_667)
    assert tuple(pose[2]) == pose_of(scan, 2).position_mm
    assert (report[1]["frames"], report[1]["unseen"]) == (4, "out of volume")
    feed.close()
    assert list(reader) == [[]]


def test_a_view_that_does_not_look_costs_nothing_but_its_own_frames(scan, pipe):
    reader, feed = pipe
    for i in range(3000):
        feed.frame(scan.frames.counts[0], i)
    seen = [one for _ in range(100) for one in next(reader)]
    assert 0 < len(seen) < 3000
    assert [one[1] for one in seen] == list(range(len(seen)))


def test_a_view_that_has_gone_does_not_stop_the_recording(scan):
    theirs, ours = os.pipe()
    feed = Feed(ours)
    os.close(theirs)
    feed.frame(scan.frames.counts[0], 0)  # raises nothing


def test_the_live_map_is_the_map_of_all_frames_on_its_plane(scan, state):
    assert state.tactile_map is not None
    live = LiveMap(scan.head, scan.element_calibration)
    live.take(seen_of(scan))
    plane = live.state().tactile_map.plane_from_base
    whole = MapAccumulator(scan.head, scan.element_calibration, plane_from_base=plane)
    known = scan.frames.time_s <= scan.poses.time_s[-1]  # the rest is still waiting for the tracker
    whole.add(scan.frames.counts[known], poses_at(distinct_poses(scan.poses), scan.frames.time_s[known]))
    np.testing.assert_array_equal(live.state().tactile_map.mean, whole.snapshot().mean)


@pytest.mark.parametrize(
    ("kpa", "tone", "said"),
    [(3.0, "low", "press harder"), (9.0, "in", "in range"), (16.0, "high", "press less"), (np.nan, "off", "waiting")],
)
def test_the_tone_follows_the_window(kpa, tone, said):
    state = LiveState(pressure_kpa=kpa)
    assert state.tone == tone
    assert said in live_line(state)
    assert page_state(state)["tone"] == tone
    json.dumps(page_state(state), allow_nan=False)


def test_a_view_says_why_there_is_no_size_yet(state):
    assert "no frames have come" in LiveState().size_words
    assert "the tracker has sent no pose" in LiveState(frames=9).size_words
    assert "pressed at 5 to 14 kPa" in LiveState(frames=9, poses=5).size_words
    assert "the first estimate is being computed" in replace(state, size="").size_words
    for blank in (LiveState(), replace(state, pressure_kpa=np.nan)):
        assert "nan" not in live_text(blank, columns=80, lines=24, colour=False)
        assert "nan" not in live_line(blank)


def test_a_screen_names_its_keys_colours_scale_and_the_lump(state):
    marked = replace(state, lump_base_mm=np.linalg.inv(state.tactile_map.plane_from_base)[:3, 3])
    text = live_text(marked, columns=100, lines=40, colour=False, keys=True)
    assert "keys: n sternal notch, x xiphoid, p nipple, space start, q stop" in text
    assert "pressure / mean of its frame: dark " in text
    assert "a character is 1 mm wide; X the lump" in text
    assert sum(line.count("X") for line in text.splitlines() if line.startswith("    ")) == 1
    assert "1.0 s, 200 frames" in text
    assert "keys" not in live_text(state, columns=100, lines=40, colour=False)


def test_a_screen_tells_of_the_landmarks(scan):
    live = LiveMap(scan.head, scan.element_calibration)
    assert live.state().landmark_words == ""
    live.take([("landmark", "sternal_notch", (1.0, 2.0, 3.0))])  # of a file
    assert live.state().landmark_words == "landmarks: sternal notch"
    touched = "xiphoid at 1.0 2.0 3.0 mm, spread 3.10 mm over 60 samples; the head moved, touch it again"
    live.take([("landmark", "xiphoid", (1.0, 2.0, 3.0)), ("report", {"touched": touched})])
    text = live_text(live.state(), columns=60, lines=24, colour=False, keys=True)
    assert max(map(len, text.splitlines())) <= 60
    assert f"landmarks: sternal notch, xiphoid; {touched}" in " ".join(text.split())


def test_landmarks_in_one_place_give_a_view_no_patient_axes(scan):
    live = LiveMap(scan.head, scan.element_calibration)
    live.take([("landmark", name, (1.0, 2.0, 3.0)) for name in ("sternal_notch", "xiphoid")])
    live.take(seen_of(scan))
    assert live.state().tactile_map.patient_from_plane is None


@pytest.mark.parametrize(("columns", "lines"), [(110, 40), (60, 20), (30, 8)])
@pytest.mark.parametrize("colour", [True, False])
def test_a_screen_fits_and_says_what_matters(state, columns, lines, colour):
    text = live_text(state, columns=columns, lines=lines, colour=colour)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    assert ("\x1b" in text) == colour
    assert len(plain.splitlines()) <= lines
    assert max(map(len, plain.splitlines())) <= columns
    assert "200 frames, 3 lost" in plain
    assert "largest size 15.0 mm"[:columns] in plain
    assert "Research use only"[:columns] in plain


def test_the_picture_is_brightest_at_the_lump(state):
    levels = grey_levels(state.tactile_map.mean)
    row, column = np.unravel_index(np.nanargmax(np.where(np.isnan(levels), -1, levels)), levels.shape)
    assert abs(state.tactile_map.x_mm[column] - np.mean(state.tactile_map.x_mm)) < 12
    assert abs(state.tactile_map.y_mm[row] - np.mean(state.tactile_map.y_mm)) < 12


@pytest.mark.parametrize(
    ("environment", "wanted"),
    [
        ({"TERM": "xterm-256color"}, True),
        ({"TERM": "xterm-256color", "NO_COLOR": "1"}, False),
        ({"TERM": "xterm", "NO_COLOR": ""}, True),
        ({"TERM": "dumb"}, False),
        ({}, False),
    ],
)
def test_colours_are_left_out_where_they_are_not_wanted(environment, wanted):
    assert has_styles(environment) is wanted


@pytest.mark.long
def test_record_shows_a_line_a_second_where_it_cannot_draw(run_cli, tmp_path, scan):
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.files.scan_mcap import write_scan

    write_scan(tmp_path / "like.mcap", scan, provenance=Provenance("test", {}))
    with head_and_tracker(short_scan(1.0)) as devices:
        words = [*devices, "--like", "like.mcap", "--live", "--serve", "127.0.0.1:0"]
        done = run_cli("record", "-o", "a.mcap", *words, cwd=tmp_path, env={"TERM": "dumb"})
    assert done.returncode == 0, done.stderr
    assert "frames lost 0" in done.stdout
    assert re.search(r"kPa in range; [\d.]+ s, \d+ frames, 0 lost", done.stderr)
    assert re.search(r"live view: http://127\.0\.0\.1:\d+/\?token=\S{32}", done.stderr)


@pytest.fixture
def server():
    server = LiveServer("127.0.0.1", 0)
    yield server
    server.close()


def get(url: str, **headers: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_the_page_is_for_those_who_know_the_address(server):
    status, page = get(server.url)
    assert status == 200
    assert "Research use only" in page
    assert not re.search(r"(src|href)=", page)  # it loads nothing
    assert get(server.url.split("?")[0])[0] == 403
    assert get(server.url.split("token")[0] + "token=guess")[0] == 403
    assert get(server.url.replace("/?", "/other?"))[0] == 404
    assert get(server.url, Host="evil.example")[0] == 403


@pytest.mark.long
def test_connections_without_the_token_do_not_end_the_page(server):
    """Some 250 of them took all file descriptors, and the server never accepted another."""
    host, port = server.url.split("/")[2].split(":")
    flood = (
        "import socket\ninput()\nkept = []\nfor i in range(300):\n"
        f"    kept.append(socket.create_connection(({host!r}, {port}), timeout=20))\n"
        "    if i % 2: kept[-1].send(b'GET / HTTP/1.1\\r\\n')\n"
        "print(len(kept), flush=True)\ninput()\n"
    )
    ends = subprocess.PIPE
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    with subprocess.Popen([sys.executable, "-c", flood], stdin=ends, stdout=ends, text=True, bufsize=1) as flooding:
        used = len(list(Path("/proc/self/fd").iterdir()))
        resource.setrlimit(resource.RLIMIT_NOFILE, (used + 180, limit[1]))
        try:
            assert flooding.stdin is not None
            assert flooding.stdout is not None
            flooding.stdin.write("go\n")
            assert flooding.stdout.readline() == "300\n"
            assert get(server.url)[0] == 200
            assert get(server.url.split("?")[0])[0] == 403
        finally:
            flooding.kill()
            resource.setrlimit(resource.RLIMIT_NOFILE, limit)


def test_the_websocket_takes_its_own_page_only(server, state):
    origin = server.url.split("/?")[0]
    address = server.url.replace("http", "ws").replace("/?", "/live?")
    with connect(address, origin=origin) as socket:
        server.show(state)
        assert json.loads(socket.recv(timeout=5))["tone"] == "in"
    for wrong in ({"uri": address, "origin": "http://evil.example"}, {"uri": address, "origin": None}):
        with pytest.raises(InvalidStatus, match="403"):
            connect(**wrong)
    with pytest.raises(InvalidStatus, match="403"):
        connect(address.split("token")[0] + "token=guess", origin=origin)


@pytest.mark.parametrize("text", ["0.0.0.0:8000", "192.168.1.7:80", "example.org:80", "8000", "127.0.0.1:x", "::1"])
def test_only_this_computer_can_be_served(text):
    with pytest.raises(UsageError):
        parse_address(text)


@pytest.mark.parametrize(
    ("text", "address"),
    [("127.0.0.1:0", ("127.0.0.1", 0)), ("localhost:8000", ("127.0.0.1", 8000)), ("[::1]:9", ("::1", 9))],
)
def test_an_address_of_this_computer(text, address):
    assert parse_address(text) == address


def test_the_estimate_looks_at_one_rise_a_time_and_stays_where_a_lump_was():
    turn, seen, shown = RiseRotation(), [], []
    for _ in range(20):
        seen.append(turn.next_of(4))
        shown.append(turn.record(lump=seen[-1] == 2))
    assert seen == [0, 1, 2, 2, 2, 2, 2, 0, 2, 2, 2, 2, 2, 2, 2, 0, 2, 2, 2, 2]
    assert [place for place, told in enumerate(shown) if not told] == [7, 15]  # a glance at the highest: nothing new
    turn = RiseRotation()
    assert [(turn.next_of(2), turn.record(lump=False))[0] for _ in range(5)] == [0, 1, 0, 1, 0]
    higher = RiseRotation()
    assert [(at := higher.next_of(3), higher.record(lump=at == 1))[0] for _ in range(4)] == [0, 1, 1, 1]
    for _ in range(4):
        at = higher.next_of(3)
        higher.record(lump=True)
    assert at == 0  # a new highest one is taken when it is looked at


def test_the_next_fit_of_a_lump_begins_with_its_width_and_a_glance_does_not():
    turn, begun = RiseRotation(), []
    for number in range(9):
        turn.next_of(2)
        begun.append(turn.width_mm)
        turn.record(lump=number > 0 and number != 7, width_mm=4.0 + number)
    assert begun == [None, None, 5.0, 6.0, 7.0, 8.0, 9.0, None, 10.0]


def test_the_live_estimate_is_the_estimate(state):
    from tactile_bayes.posterior.draw import SamplerSettings
    from tactile_bayes.posterior.estimate import estimate_map

    text, lump_base_mm = live_estimate(state.tactile_map, None, RiseRotation())
    options = SamplerSettings(method="laplace", rotation="off")
    found = estimate_map(state.tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    widths = np.maximum(found.map_posterior.sigma_x_mm, found.map_posterior.sigma_y_mm)
    assert text.startswith(f"map width sigma {np.median(widths):.1f} mm (")
    flat = replace(state.tactile_map, mean=np.where(state.tactile_map.covered, 1.0, np.nan))
    assert live_estimate(flat, None, RiseRotation()).text.startswith("no estimate: ")
    x, y = replace(state, lump_base_mm=lump_base_mm).lump_mm
    assert (x, y) == pytest.approx((np.median(found.map_posterior.x_mm), np.median(found.map_posterior.y_mm)), abs=0.05)


@pytest.mark.long
def test_the_live_view_of_a_recording_estimates_the_size_while_it_grows(run_python, tmp_path):
    demo = Path(__file__).resolve().parents[2] / "tactile_bayes" / "demo" / "scan.mcap"
    words = ("replay", demo, "-o", "again.mcap", "--serve", "127.0.0.1:0", "--force", "--speed")
    for speed in (1.0, 0.2):  # more time on a computer that is busy
        done = run_python("-m", "tactile_bayes", *words, speed, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        estimates = re.search(r"(\d+) estimates in", done.stderr)
        assert estimates is not None, done.stderr
        if int(estimates[1]) > 1:  # its first answer is that it is there
            return
    pytest.fail("the process that estimates does not answer")
