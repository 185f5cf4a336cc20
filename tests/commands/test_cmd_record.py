"""`record` against emulated devices, and everything that can end it."""

from __future__ import annotations

import fcntl
import os
import pty
import resource
import signal
import stat
import struct
import subprocess
import sys
import termios
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from emulated_devices import head_and_tracker, serving, short_scan, wait_for_bytes
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tactile_bayes.cli import cli
from tactile_bayes.declarations import replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report, write_scan
from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedTracker, Faults, PtyLink
from tactile_bayes.hardware.ports import Port
from tactile_bayes.mapping.build import build_map
from tactile_bayes.presets import MM_PER_UNIT
from tactile_bayes.scans import Scan


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("source") / "source.mcap"
    write_scan(path, short_scan(), provenance=Provenance("test", {}))
    return path


@pytest.fixture(scope="module")
def scan(source) -> Scan:
    return read_scan(source)


@pytest.fixture(scope="module")
def long_scan() -> Scan:
    return short_scan(4.0)


@pytest.fixture
def start(child_environment, tmp_path, source):
    """Start `record` in the background: ``start(words, output)``."""
    processes = []

    def begin(words, output="a.mcap", **options):
        arguments = [sys.executable, "-m", "tactile_bayes", "record", "-o", output, *words, "--like", source]
        process = subprocess.Popen(
            [str(word) for word in arguments],
            cwd=tmp_path,
            env=child_environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **options,
        )
        processes.append(process)
        return process

    yield begin
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def record(tmp_path, source, monkeypatch):
    """Run `record` in this process, without a terminal: ``record(*words)``, in `tmp_path`, like `source`."""
    monkeypatch.chdir(tmp_path)

    def run(*words, like=True):
        given = [*words, *(["--like", source] if like else [])]
        done = CliRunner().invoke(cli, ["record", "-o", "a.mcap", *map(str, given)])
        error = done.exception
        known = isinstance(error, TactileBayesError)
        if error is not None and not known and not isinstance(error, SystemExit):
            raise error
        return subprocess.CompletedProcess(
            given,
            error.exit_code if known else done.exit_code,
            done.stdout,
            done.stderr + (f"error: {error}\n" if known else ""),
        )

    return run


# The emulated devices run faster than life where nothing depends on the time it takes.
FAST = 5.0


def notes(path: Path) -> list[tuple[str, str]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(m.name, m.message) for _, _, _, m in reader.iter_decoded_messages(topics=["/log"])]


@pytest.mark.parametrize("tcp", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["pty", "tcp"])
def test_a_recorded_scan_gives_the_bit_identical_map(record, tmp_path, source, scan, tcp):
    with head_and_tracker(scan, tcp=tcp, speed=FAST) as devices:
        (tmp_path / "s.toml").write_text('side = "left"\nexaminer = "E7"\nvisit = "2"\n')
        words = ["--clock", "shared", "--landmarks", source, "--side", "phantom", "--session", "s.toml"]
        done = record(*devices, *words)
    assert done.returncode == 0, done.stderr
    assert "200 frames in 0.995 s, 200.0 Hz; 120 poses" in done.stdout
    assert "frames lost 0" in done.stdout
    assert NOMINAL not in done.stdout
    path = tmp_path / "a.mcap"
    file = read_scan_report(path)
    assert file.complete
    np.testing.assert_array_equal(file.scan.frames.counts, scan.frames.counts)
    np.testing.assert_array_equal(file.scan.frames.time_s, scan.frames.time_s)
    one, other = build_map([file.scan]), build_map([scan])
    for name in ("mean", "variance", "count", "x_mm", "y_mm", "plane_from_base", "patient_from_plane"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    session = file.scan.session
    assert (session["side"], session["examiner"], session["visit"]) == ("phantom", "E7", "2"), "an option goes first"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.long
def test_the_reference_reader_opens_a_recording(record, tmp_path, scan):
    with head_and_tracker(scan, head_faults=Faults(drop=0.05), speed=FAST) as devices:
        done = record(*devices)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        kinds = {schema.name for schema, *_ in reader.iter_decoded_messages()}
        counts = reader.get_summary().statistics.channel_message_counts
        account = {m.name: m.metadata for m in reader.iter_metadata()}["recording"]
    assert kinds == {"foxglove.Grid", "foxglove.PoseInFrame", "foxglove.Log"}
    lost = int(account["frames_lost"])
    assert lost > 0
    assert counts[1] == int(account["frames"]) == 200 - lost
    gaps = [int(text.split()[0]) for device, text in notes(tmp_path / "a.mcap") if device == "head"]
    assert sum(gaps) == lost
    assert f"frames lost {lost}" in done.stdout


NOMINAL = "the nominal gain is for bladder steps: uneven taxels may hide a lump or pass for one"


@pytest.mark.parametrize(
    "protocol",
    [
        "fastrak",
        "bird",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("liberty", "liberty-ascii", "igtlink")),
    ],
)
def test_every_tracker_is_recorded_as_its_wire_carries_it(record, tmp_path, scan, protocol):
    tcp = protocol == "igtlink"
    with head_and_tracker(scan, protocol=protocol, tcp=tcp, speed=1.0 if tcp else FAST) as devices:
        done = record(*devices, "--uncalibrated")
    assert done.returncode == 0, done.stderr
    assert f"caution: {NOMINAL}\n" in done.stdout
    recorded = read_scan(tmp_path / "a.mcap")
    assert NOMINAL in [one.text for one in recorded.findings]  # for its maps
    poses = recorded.poses
    step = {"bird": 0.12, "liberty-ascii": 2e-4}.get(protocol, 1e-4)
    # poses before the head's first frame have no time, and the last may come after the head has stopped
    assert 10 <= len(poses) <= 120
    apart = np.abs(poses.position_mm[:, None] - scan.poses.position_mm[None]).max(axis=2)
    assert apart.min(axis=1).max() < step
    assert np.diff(poses.time_s).min() >= 0


def test_the_nominal_gain_of_a_scan_to_record_like_is_told(record, tmp_path, scan):
    """It was taken without a word: the scan it came from was recorded for bladder steps."""
    step = scan.element_calibration
    nominal = replace(step, gain_kpa_per_count=np.full_like(step.gain_kpa_per_count, 34 / step.saturation_count))
    nominal = replace(nominal, offset_kpa=np.zeros_like(step.offset_kpa))
    write_scan(tmp_path / "p8.mcap", replace(scan, element_calibration=nominal), provenance=Provenance("test", {}))
    with head_and_tracker(scan, speed=FAST) as devices:
        done = record(*devices, "--like", "p8.mcap", like=False)
    assert done.returncode == 0, done.stderr
    assert f"caution: {NOMINAL}\n" in done.stdout


@pytest.mark.long
def test_a_shared_clock_and_single_precision_give_the_map_of_the_scan_as_the_wire_carries_it(record, tmp_path, scan):
    with head_and_tracker(scan, protocol="liberty", speed=FAST) as devices:
        words = [*devices, "--clock", "shared"]
        done = record(*words)
    assert done.returncode == 0, done.stderr
    got = read_scan(tmp_path / "a.mcap").poses
    inches = (scan.poses.position_mm / MM_PER_UNIT["in"]).astype(np.float32).astype(np.float64)
    np.testing.assert_array_equal(got.position_mm, inches * MM_PER_UNIT["in"])
    np.testing.assert_array_equal(got.quaternion_wxyz, scan.poses.quaternion_wxyz.astype(np.float32))
    np.testing.assert_array_equal(np.rint(got.time_s * 1000), np.floor(scan.poses.time_s * 1000 + 1e-6))


@pytest.mark.long
def test_faults_are_counted_and_noted(record, tmp_path, scan):
    spoilt, held = Faults(corrupt=0.1, stall=(0.3, 0.1)), Faults(hold=3)
    with head_and_tracker(scan, head_faults=spoilt, tracker_faults=held, speed=FAST) as devices:
        done = record(*devices)
    assert done.returncode == 0, done.stderr
    assert "the head dropped 20" in done.stdout
    assert "bytes from the head that made no sense" in done.stdout
    repeated = [text for device, text in notes(tmp_path / "a.mcap") if device == "tracker" and "repeated" in text]
    assert len(repeated) >= 30
    assert f"poses repeated {len(repeated)}" in done.stdout
    frames = read_scan(tmp_path / "a.mcap").frames
    rows = np.rint(frames.time_s * 200).astype(int)
    np.testing.assert_array_equal(frames.counts, scan.frames.counts[rows])


@pytest.mark.long
def test_a_kill_costs_the_last_fraction_of_a_second(tmp_path, start, run_cli, long_scan):
    with head_and_tracker(long_scan) as devices:
        process = start(devices)
        wait_for_bytes(tmp_path / "a.mcap", 120_000)
        process.send_signal(signal.SIGKILL)
        process.wait()
    file = read_scan_report(tmp_path / "a.mcap")
    assert not file.complete
    assert "everything after" in file.lost[0]
    assert len(file.scan.frames) >= 50
    done = run_cli("repair", "a.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "everything after" in done.stdout
    mended = read_scan_report(tmp_path / "a.mcap")
    assert mended.complete
    np.testing.assert_array_equal(mended.scan.frames.counts, file.scan.frames.counts)


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGTERM, "SIGTERM"),
        pytest.param(signal.SIGINT, "Ctrl-C", marks=pytest.mark.slow),
    ],
)
def test_a_signal_ends_the_recording_in_order(tmp_path, start, long_scan, number, words):
    with head_and_tracker(long_scan) as devices:
        process = start(devices)
        wait_for_bytes(tmp_path / "a.mcap", 60_000)
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    assert f"ended by {words}" in out
    file = read_scan_report(tmp_path / "a.mcap")
    assert file.complete
    assert f"{len(file.scan.frames)} frames" in out


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_all_processes_of_a_recording_ends_it_in_order(tmp_path, start, long_scan, number):
    """As of `timeout`, a service manager and a closed terminal: the readers died of it, and "the device has gone"."""
    with head_and_tracker(long_scan) as devices:
        process = start(devices, start_new_session=True)
        wait_for_bytes(tmp_path / "a.mcap", 60_000)
        os.killpg(process.pid, number)
        out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    assert f"ended by {number.name}" in out
    assert read_scan_report(tmp_path / "a.mcap").complete


@pytest.mark.long
@pytest.mark.parametrize("role", ["head", "tracker"])
def test_a_pulled_cable_ends_it_with_one_line(record, tmp_path, scan, role):
    pulled = {f"{role}_faults": Faults(disconnect_s=0.3)}
    with head_and_tracker(scan, **pulled) as devices:
        done = record(*devices)
    assert done.returncode == 4, done.stderr
    assert done.stderr.count("\n") == 1
    url = devices[devices.index(f"--{role}") + 1]
    assert done.stderr.startswith(f"error: {role} {url}: more data was expected, the device has gone ")
    file = read_scan_report(tmp_path / "a.mcap")
    assert file.complete
    assert 0 < len(file.scan.frames) < 200


@pytest.mark.long
def test_a_full_disk_ends_it_with_one_line_and_keeps_what_was_written(tmp_path, start, long_scan):
    def little_room() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (120_000, 120_000))

    with head_and_tracker(long_scan) as devices:
        process = start(devices, preexec_fn=little_room)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 2, "as for any output that cannot be written"
    assert "a.mcap: cannot be written any further (File too large); what was recorded" in err
    assert err.count("\n") == 1
    assert "`tactile-bayes repair`" in err
    assert len(read_scan_report(tmp_path / "a.mcap").scan.frames) > 50


@pytest.mark.long
def test_a_disk_that_was_full_before_it_is_one_line_and_no_file(tmp_path, start, long_scan):
    """It was: error: No space left on device, with exit code 1 and an empty file."""

    def no_room() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))

    with head_and_tracker(long_scan) as devices:
        process = start(devices, preexec_fn=no_room)
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err.count("\n")) == (2, 1), err
    assert "a.mcap cannot be written (File too large)" in err
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.long
def test_a_duration_is_by_the_heads_clock(record, tmp_path, scan):
    with head_and_tracker(scan, speed=FAST) as devices:
        words = [*devices, "--clock", "shared", "--duration", 0.5]
        done = record(*words)
    assert done.returncode == 0, done.stderr
    assert "100 frames in 0.495 s" in done.stdout
    recorded = read_scan(tmp_path / "a.mcap")
    assert recorded.poses.time_s[-1] >= recorded.frames.time_s[-1] - 0.01


@pytest.mark.long
def test_one_frame_in_four_is_asked_for(record, tmp_path, scan):
    with head_and_tracker(scan, speed=FAST) as devices:
        done = record(*devices, "--every", 4)
    assert done.returncode == 0, done.stderr
    assert "one frame in 4: 50 Hz" in done.stderr
    assert "frames lost 0" in done.stdout
    np.testing.assert_array_equal(read_scan(tmp_path / "a.mcap").frames.counts, scan.frames.counts[::4])


@pytest.mark.long
def test_a_rotation_can_be_turned_round(record, tmp_path, scan):
    with head_and_tracker(scan, speed=FAST) as devices:
        words = [*devices, "--clock", "shared", "--invert-rotation"]
        done = record(*words)
    assert done.returncode == 0, done.stderr
    recorded = read_scan(tmp_path / "a.mcap")
    np.testing.assert_array_equal(recorded.poses.quaternion_wxyz, scan.poses.quaternion_wxyz * [1, -1, -1, -1])
    assert recorded.session["rotation"] == "inverted"


def test_no_trace_is_left_when_the_devices_are_not_there(record, tmp_path):
    done = record("--head", "/dev/nothing")
    assert done.returncode == 4
    assert done.stderr == (
        "error: head /dev/nothing: cannot be opened (No such file or directory); "
        "`tactile-bayes devices` lists what is there\n"
    )
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(("subject", "visit"), [("P2", "1"), ("P1", "2")])
def test_landmarks_of_another_patient_or_visit_are_refused(record, scan, tmp_path, subject, visit):
    """Places on the breast were measured from the other one's sternum."""
    one = replace(scan, session={"subject": "P1", "visit": "1"})
    write_scan(tmp_path / "last.mcap", one, provenance=Provenance("test", {}))
    (tmp_path / "s.toml").write_text(f'visit = "{visit}"\n')
    done = record("--head", "/dev/nothing", "--landmarks", "last.mcap", "--subject", subject, "--session", "s.toml")
    assert done.returncode == 2
    assert "are of subject P1, this is P2" in done.stderr or "are of visit 1, this is 2; touch them anew" in done.stderr


def test_one_port_for_both_devices_is_refused(record):
    """It was opened twice: "Resource temporarily unavailable", from the devices' own error code."""
    done = record("--head", "/dev/nothing", "--tracker", "/dev/nothing")
    assert done.returncode == 2
    assert done.stderr == "error: --head and --tracker are both /dev/nothing; give two ports\n"


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("socket://127.0.0.1:9", "cannot be opened (Connection refused); `tactile-bayes devices`"),
        ("rfc2217://127.0.0.1:9", "cannot be opened (Connection refused); `tactile-bayes devices`"),
        ("/dev/null", "cannot be opened (Inappropriate ioctl for device); `tactile-bayes devices`"),
        ("socket://127.0.0.1", "not a port (no port number up to 65535); give socket://HOST:PORT"),
        ("socket://[::1]", "not a port (no port number up to 65535); give socket://HOST:PORT"),
        ("socket://127.0.0.1:99999", "not a port (no port number up to 65535); give socket://HOST:PORT"),
    ],
)
def test_a_port_that_cannot_be_opened_is_told_in_the_systems_words(record, url, words):
    """pyserial wraps them in text of its own; without a port number it fails over a comparison."""
    done = record("--head", url)
    assert done.returncode == 4
    assert done.stderr.startswith(f"error: head {url}: {words}")
    assert done.stderr.count("\n") == 1


def test_a_port_in_use_is_refused(record, scan):
    with serving(EmulatedHead(scan), PtyLink()) as emulator:
        other = Port(emulator.link.url, baud=9600, role="head")
        done = record("--head", emulator.link.url)
        other.close()
    assert done.returncode == 4
    assert "cannot be opened" in done.stderr


@pytest.mark.long
def test_another_device_on_the_port_is_told_by_what_it_says(record, scan, monkeypatch):
    monkeypatch.setattr("tactile_bayes.hardware.serial_trackers.ANSWER_S", 0.3)
    with serving(EmulatedTracker(scan.poses, protocol="bird"), PtyLink()) as emulator:
        done = record("--head", emulator.link.url)
    assert done.returncode == 4
    assert "a HELLO packet was expected, " in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ([], 2, "--head-geometry HEAD.json or --like SCAN.mcap"),
        (["--head", "nonsense://x", "--like", "SOURCE"], 4, "not a port"),
        (["--head-baud", "115200", "--like", "SOURCE"], 4, "--every 15"),
        (["--tracker", "/dev/nothing", "--like", "SOURCE"], 4, "tracker /dev/nothing: cannot be opened"),
        (["--tracker", "", "--like", "SOURCE"], 2, "--tracker is empty; give the tracker's port"),
        (
            ["--uncalibrated", "--array-calibration", "SOURCE", "--like", "SOURCE"],
            2,
            "--uncalibrated leaves --array-calibration unused; give one of them",
        ),
        (["--tool", "Probe", "--like", "SOURCE"], 2, "--tool and --reference are of a tracker; give its port"),
        (["--examiner", "Dr Who", "--like", "SOURCE"], 3, "error: --examiner: examiner is 'Dr Who'; give a text"),
        (
            ["--size-calibration", "no.json", "--live", "--uncalibrated", "--like", "SOURCE"],
            3,
            "no.json: cannot be read",
        ),
    ],
)
def test_mistakes_end_in_one_line(record, tmp_path, source, scan, words, code, said):
    with head_and_tracker(scan, speed=FAST) as devices:
        given = [str(source) if word == "SOURCE" else word for word in words]
        url = [] if "--head" in given else devices[:2]
        done = record(*url, *given, like=False)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


SESSIONS = {
    'clock = "shared"': "clock is set by the recording itself; leave clock out",
    'subject = "two words"': "subject is 'two words'; give a text in quotes of up to 32 letters",
    "subject = 7": "subject is 7; give a text in quotes",
    'patient_name = "x"': "patient_name may not be given; leave it out",
    'Side = "left"': "'Side' is not known; did you mean side?",
    'reference = "7"': "reference is set by the recording itself",
    'subjct = "P031"': "subjct is not known; did you mean subject?",
    'laterality = "left"': "laterality is not known; did you mean side?",
    'seite = "left"': "seite is not known; did you mean side?",
    'patient_id = "P031"': "patient_id is not known; did you mean subject?",
    "date = 2026-11-27": "date is 2026-11-27; give a text in quotes",
    'side = "Left"': "side is 'Left'; did you mean left? Give one of left, right, phantom",
    "side = left": "is not TOML",
}


@pytest.mark.parametrize("text", SESSIONS)
def test_a_session_file_is_checked_before_a_port_is_opened(record, tmp_path, text):
    (tmp_path / "s.toml").write_text(text)
    done = record("--head", "/dev/nothing", "--session", "s.toml")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert SESSIONS[text] in done.stderr
    assert [one.name for one in tmp_path.iterdir()] == ["s.toml"]


@pytest.mark.long
def test_keys_touch_landmarks_start_and_stop(child_environment, tmp_path, source, long_scan):
    near, far = pty.openpty()
    with head_and_tracker(long_scan) as devices:
        words = [sys.executable, "-m", "tactile_bayes", "record", "-o", "a.mcap", *devices, "--like", str(source)]
        process = subprocess.Popen(
            words, cwd=tmp_path, env=child_environment, stdin=far, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        assert process.stderr is not None
        assert b"space start" in process.stderr.readline()
        for key, *answers in (
            (b"n", b"sternal notch: hold still", b"sternal notch at"),
            (b"x", b"xiphoid: hold still", b"xiphoid at"),
            (b" ", b"recording"),
        ):
            os.write(near, key)
            for answer in answers:
                assert answer in process.stderr.readline()
        wait_for_bytes(tmp_path / "a.mcap", 60_000)
        os.write(near, b"q")
        out, err = process.communicate(timeout=20)
    os.close(near)
    os.close(far)
    assert process.returncode == 0, err
    assert b"spread" in out
    assert b"not stored: this is the place of the sternal notch" in out  # the emulated tracker rests
    assert read_scan(tmp_path / "a.mcap").landmarks is None  # one of 0 mm would have no map


@pytest.mark.long
def test_a_live_view_keeps_the_words_that_confirm_a_landmark(child_environment, tmp_path, source, long_scan):
    """They were printed beside the view, which drew over them at once."""
    near, far = pty.openpty()
    fcntl.ioctl(far, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
    environment = {**child_environment, "TERM": "xterm"}
    with head_and_tracker(long_scan) as devices:
        words = [sys.executable, "-m", "tactile_bayes", "record", "-o", "a.mcap", *devices, "--like", str(source)]
        process = subprocess.Popen(
            [*words, "--live"], cwd=tmp_path, env=environment, stdin=far, stdout=subprocess.PIPE, stderr=far
        )
        os.close(far)
        shown = b""

        def shows(wanted: bytes) -> None:
            nonlocal shown
            while wanted not in shown.rpartition(b"\x1b[H")[2]:  # in the view as it was drawn last
                shown += os.read(near, 65536)

        shows(b"keys: n sternal notch")
        os.write(near, b"n")
        shows(b"landmarks: sternal notch; sternal notch at")
        os.write(near, b"x")
        shows(b"landmarks: sternal notch; xiphoid at")
        shown = b""
        os.write(near, b" ")
        shows(b"landmarks: sternal notch; xiphoid at")
        os.write(near, b"q")
        with suppress(OSError):  # the terminal is closed
            while os.read(near, 65536):
                pass
        out, _ = process.communicate(timeout=20)
    os.close(near)
    assert process.returncode == 0
    assert b"xiphoid at" in out
