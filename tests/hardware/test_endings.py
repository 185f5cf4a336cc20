"""How recordings end: devices and terminals that vanish, parents that die, browsers that do not read."""

from __future__ import annotations

import fcntl
import os
import pty
import socket
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from emulated_devices import head_and_tracker, serving, short_scan

from tactile_bayes.errors import DeviceError, UsageError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import create_exclusive, read_scan_report, write_scan
from tactile_bayes.hardware.emulated import EmulatedTracker, PtyLink
from tactile_bayes.hardware.live import LiveServer, LiveState
from tactile_bayes.hardware.ports import Port

WARM_ESTIMATOR = """
import multiprocessing, sys, time
from tactile_bayes.actions.live_view import LiveEstimator

if __name__ == "__main__":
    estimator = LiveEstimator(None)
    while estimator.done == 0:
        estimator.poll(None)
        time.sleep(0.01)
    print(*[child.pid for child in multiprocessing.active_children()], flush=True)
    if "close" in sys.argv:
        estimator.close()
    else:
        time.sleep(60)
"""


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(done, *, looks: int = 2000) -> None:
    for _ in range(looks):
        if done():
            return
        time.sleep(0.01)
    raise AssertionError("it did not come")


@pytest.mark.parametrize("action", ["write", "flush", "read"])
def test_a_device_that_vanishes_is_one_line_whatever_the_system_calls_it(monkeypatch, action):
    near, far = os.openpty()
    port = Port(os.ttyname(far), baud=9600, role="head")

    def gone(*_):
        raise termios.error(5, "Input/output error")

    monkeypatch.setattr(port._serial, action, gone)
    with pytest.raises(DeviceError, match="Input/output error\\); check its cable"):
        port.read_some(0.1) if action == "read" else port.write(b"stop")
    port.close()
    os.close(near)
    os.close(far)


@pytest.mark.long
def test_devices_that_vanish_at_the_end_leave_a_finished_file(tmp_path, child_environment):
    """A head that is unplugged just after its END: it can no longer be told to stop."""
    scan = short_scan(0.3)
    write_scan(tmp_path / "scan.mcap", scan, provenance=Provenance("test", {}))
    hushed = (
        "import sys, termios\n"
        "import tactile_bayes.hardware.recorder as recorder\n"
        "from tactile_bayes.cli import main\n"
        "done = recorder.Recorder._done\n"
        "def gone(self):\n"
        "    def fail():\n"
        "        raise termios.error(5, 'Input/output error')\n"
        "    ended = done(self)\n"
        "    for line in self._lines if ended else ():\n"
        "        line.port._serial.flush = fail\n"
        "    return ended\n"
        "recorder.Recorder._done = gone\n"
        "main()\n"
    )
    with head_and_tracker(scan) as devices:
        done = subprocess.run(
            [sys.executable, "-c", hushed, "record", "-o", "a.mcap", *devices, "--like", "scan.mcap"],
            cwd=tmp_path,
            env=child_environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert done.returncode == 0, done.stderr
    assert read_scan_report(tmp_path / "a.mcap").complete


@pytest.mark.long
def test_a_closed_terminal_ends_the_recording_in_order(tmp_path, child_environment):
    write_scan(tmp_path / "scan.mcap", short_scan(0.3), provenance=Provenance("test", {}))
    near, far = pty.openpty()
    with head_and_tracker(short_scan(8.0)) as devices:
        words = [sys.executable, "-m", "tactile_bayes", "record", "-o", "a.mcap", *devices, "--like", "scan.mcap"]
        process = subprocess.Popen(
            words,
            cwd=tmp_path,
            env=child_environment,
            stdin=far,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert "space start" in process.stderr.readline()
        os.write(near, b" ")
        assert "recording" in process.stderr.readline()
        wait_until(lambda: (tmp_path / "a.mcap").stat().st_size > 60_000)
        os.close(far)
        os.close(near)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert "ended by a closed terminal" in out
    assert read_scan_report(tmp_path / "a.mcap").complete


@pytest.mark.long_repeats
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the system does not tell of processes in /proc")
@pytest.mark.parametrize("how", ["kill", "close"])
def test_an_estimator_does_not_outlive_its_recording(tmp_path, child_environment, how):
    (tmp_path / "warm.py").write_text(WARM_ESTIMATOR)
    process = subprocess.Popen(
        [sys.executable, "warm.py", how],
        cwd=tmp_path,
        env=child_environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    children = [int(word) for word in process.stdout.readline().split()]
    assert len(children) == 1
    if how == "kill":
        process.kill()
    _, err = process.communicate(timeout=30)
    assert err == "" or how == "kill"
    wait_until(lambda: not any(is_running(pid) for pid in children))


def handshake(server: LiveServer, *extra: str, path: str = "/live") -> socket.socket:
    """A page of the server's own, or with other headers, that reads nothing yet."""
    address = urlsplit(server.url)
    lines = [
        f"GET {path}?{address.query} HTTP/1.1",
        f"Host: {address.netloc}",
        f"Origin: http://{address.netloc}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        *extra,
    ]
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    line.connect((address.hostname, address.port))
    line.sendall("\r\n".join([*lines, "", ""]).encode())
    return line


@pytest.mark.parametrize("header", ["Host: evil.example", "Origin: http://evil.example"])
def test_a_header_given_twice_is_refused(header):
    server = LiveServer("127.0.0.1", 0)
    line = handshake(server, header)
    line.settimeout(10.0)
    assert b" 403 " in line.recv(4096).splitlines()[0]
    line.close()
    server.close()


def test_a_path_that_is_no_address_is_refused_without_a_word_on_the_terminal(caplog):
    server = LiveServer("127.0.0.1", 0)
    with handshake(server, path="//[/live") as line:
        line.settimeout(10.0)
        assert b" 404 " in line.recv(4096).splitlines()[0]
    server.close()
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


@pytest.mark.long
@pytest.mark.parametrize("states", [0, 2], ids=["waiting", "full"])
def test_pages_that_do_not_read_are_cut_off(states):
    server = LiveServer("127.0.0.1", 0)
    lines = [handshake(server) for _ in range(5)]
    wait_until(lambda: len(server._pages) == 5)
    blocked = [threading.Thread(target=server.show, args=(LiveState(size="x" * 5_000_000),)) for _ in range(states)]
    for thread in blocked:
        thread.start()
        thread.join()
    time.sleep(0.2)
    closing = threading.Thread(target=server.close, daemon=True)
    closing.start()
    closing.join(20.0)
    assert not closing.is_alive()
    wait_until(lambda: not server._pages)
    # a page that says no goodbye was waited for 10 s
    wait_until(lambda: not [one for one in server._server.handler_threads if one.is_alive()], looks=500)
    for line in lines:
        line.close()


def test_a_file_that_is_being_recorded_is_left_alone(tmp_path, run_cli):
    path = tmp_path / "a.mcap"
    write_scan(path, short_scan(0.1), provenance=Provenance("test", {}))
    whole = path.read_bytes()
    path.write_bytes(whole[:-50])  # a recording that has not ended
    with path.open("rb") as recording:
        fcntl.flock(recording, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="is being recorded"):
            create_exclusive(path, force=True)
        done = run_cli("repair", "a.mcap", cwd=tmp_path)
        assert done.returncode == 2
        assert "a.mcap is being recorded; wait for its end" in done.stderr
        assert "is being recorded: what comes after" in run_cli("show", "a.mcap", cwd=tmp_path).stdout
    assert path.read_bytes() == whole[:-50]
    with create_exclusive(path, force=True) as stream, pytest.raises(UsageError, match="is being recorded"):
        create_exclusive(path, force=True)
    assert stream.closed
    assert path.read_bytes() == b""


def test_a_tracker_on_the_heads_port_is_reported(tmp_path, run_cli):
    write_scan(tmp_path / "scan.mcap", short_scan(0.1), provenance=Provenance("test", {}))
    tracker = EmulatedTracker(short_scan(0.1).poses, protocol="open")
    with serving(tracker, PtyLink()) as emulator:
        url = emulator.link.url
        done = run_cli("record", "-o", "a.mcap", "--head", url, "--like", "scan.mcap", cwd=tmp_path)
    assert done.returncode == 4
    assert done.stderr == f"error: head {url}: 'emulated tracker' is a device without taxels; give a head's port\n"
