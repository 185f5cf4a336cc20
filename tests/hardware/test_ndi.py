"""NDI trackers: what the driver asks and takes, with a stand-in for the library and, where it is installed, itself."""

# ruff: noqa: N802, ARG002 (the stand-in has the library's names)

from __future__ import annotations

import time

import numpy as np
import pytest
from emulated_devices import serving, short_scan

from tactile_bayes.errors import DeviceError, UsageError
from tactile_bayes.hardware import trackers as ndi
from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedNdi, Faults, PtyLink, TcpLink, crc16
from tactile_bayes.hardware.readings import Follower, HelloReading, MissingReading, PoseReading
from tactile_bayes.hardware.serial_trackers import TRACKERS, open_tracker
from tactile_bayes.hardware.trackers import NdiTracker

TURN = (0.5, 0.5, -0.5, 0.5)
TOOL = "0A-870030A"


class FakeLibrary:
    """Stands in for ``ndicapy``: answers from lists, keeps what it was told.

    Parameters
    ----------
    frames
        What each BX shows: (frame number, transform or ``"MISSING"``, by handle where there are several), or an error
        number; an exception is raised.
    status
        Of a handle's port.
    """

    NDI_OKAY, NDI_115200, NDI_8N1, NDI_NOHANDSHAKE = 0, 5, 0, 0

    def __init__(
        self, frames=(), *, refuse: dict[str, int] | None = None, enabled=(10,), device: object = "it", status=0
    ) -> None:
        self.told: list[str] = []
        self.opened: tuple = ()
        self._frames, self._refuse = list(frames), dict(refuse or {})
        self._handles, self._enabled, self._device = [], list(enabled), device
        self._error, self._now, self._status = 0, (0, "MISSING"), status

    def ndiOpen(self, name):
        self.opened = (name,)
        return self._device

    def ndiOpenNetwork(self, host, port):
        self.opened = (host, port)
        return self._device

    def ndiRESET(self, device):
        self.told.append("a break")
        self._refuse.pop("INIT", None)

    def ndiCommand(self, device, text, *values):
        line = text % values
        name = line.partition(":")[0]
        self.told.append(line)
        self._error = self._refuse.get(name, 0)
        if name == "PHSR":
            self._handles = self._enabled if line.endswith("04") else []
        if name == "BX" and self._frames:
            found = self._frames.pop(0)
            if isinstance(found, Exception):
                raise found
            self._error, self._now = (found, self._now) if isinstance(found, int) else (0, found)
        if name == "PHINF":
            return f"  87003{line[6:8]}".ljust(20)
        return "Polaris\nNDI S/N:P6-00057" if name == "VER" else "OKAY"

    def ndiGetError(self, device):
        return self._error

    def ndiErrorString(self, number):
        return f"error {number}"

    def ndiGetPHSRNumberOfHandles(self, device):
        return len(self._handles)

    def ndiGetPHSRHandle(self, device, index):
        return self._handles[index]

    def ndiGetPHRQHandle(self, device):
        return 10

    def ndiPVWRFromFile(self, device, handle, path):
        self.told.append(f"description of {handle}")
        return 0 if path.endswith(".rom") else -1

    def ndiGetBXFrame(self, device, port):
        assert port[0] in self._enabled
        return self._now[0]

    def ndiGetBXTransform(self, device, port):
        return self._now[1][port[0]] if isinstance(self._now[1], dict) else self._now[1]

    def ndiGetBXPortStatus(self, device, port):
        return self._status


def test_a_tracker_is_set_up_in_the_order_of_the_guide(tmp_path):
    library = FakeLibrary()
    tracker = NdiTracker(library, "/dev/ttyUSB0", roms=[tmp_path / "probe.rom"])
    assert library.opened == ("/dev/ttyUSB0",)
    words = [line.partition(":")[0] for line in library.told]
    assert words == ["INIT", "COMM", "VER", "PHSR", "PHRQ", "description of 10", *["PHSR"] * 3, "TSTART"]
    assert library.told[1] == "COMM:50000"  # 115200, 8N1, no handshake
    assert (tracker.name, tracker.tools) == ("Polaris", {10: "probe"})
    over_network = FakeLibrary()
    NdiTracker(over_network, "socket://169.254.60.146:8765")
    assert over_network.opened == ("169.254.60.146", 8765)
    assert not any(line.startswith("COMM") for line in over_network.told)


def test_a_tracker_left_at_another_rate_is_reset():
    library = FakeLibrary(refuse={"INIT": 0xF6})
    NdiTracker(library, "/dev/ttyUSB0")
    assert library.told[:3] == ["INIT:", "a break", "INIT:"]


def test_a_device_that_is_no_ndi_tracker_is_refused_in_words():
    """Its failed reset was a traceback."""

    class Deaf(FakeLibrary):
        def ndiRESET(self, device):
            raise OSError("Error 0x0106: Measurement System failed to reset on break")

    with pytest.raises(DeviceError, match="INIT failed"):
        NdiTracker(Deaf(refuse={"INIT": 0xF6}), "/dev/ttyUSB0")


def test_new_frames_with_a_tool_in_sight_are_poses():
    seen = (*TURN, 254.0, -127.0, 25.4, 0.2)
    spoilt = OSError("POLARIS 0x04: Invalid CRC")
    frames = [(1, seen), (1, seen), (2, "MISSING"), (3, seen), 4, spoilt, (4, (9.0,) * 8), (5, seen)]
    tracker = NdiTracker(FakeLibrary(frames), "/dev/ttyUSB0")
    found = [tracker.measure() for _ in frames]
    pose, unseen = [PoseReading((254.0, -127.0, 25.4), TURN, tool=TOOL)], [MissingReading("missing", TOOL)]
    none = [MissingReading("no rotation", TOOL)]
    assert found == [pose, [], unseen, pose, [], [], none, pose]  # again, unseen, twice spoilt, impossible


@pytest.mark.parametrize(
    ("status", "seen", "found"),
    [
        (0x31, "MISSING", MissingReading("missing", TOOL)),
        (0x71, "MISSING", MissingReading("out of volume", TOOL)),
        (0x01, "DISABLED", MissingReading("disabled", TOOL)),
        (0xB1, (*TURN, 1.0, 2.0, 3.0, 0.1), PoseReading((1, 2, 3), TURN, None, ("partly out of volume",), TOOL)),
    ],
)
def test_a_ports_status_says_why_there_is_no_pose(status, seen, found):
    assert NdiTracker(FakeLibrary([(1, seen)], status=status), "/dev/ttyUSB0").measure() == [found]


def test_each_enabled_tool_is_read_and_named_by_handle_and_part():
    seen = (*TURN, 1.0, 2.0, 3.0, 0.2)
    library = FakeLibrary([(1, {10: seen, 11: "MISSING"})], enabled=(10, 11))
    tracker = NdiTracker(library, "/dev/ttyUSB0")
    assert tracker.measure() == [
        PoseReading((1, 2, 3), TURN, tool="0A-870030A"),
        MissingReading("missing", "0B-870030B"),
    ]


def test_a_tracker_that_stops_answering_is_reported():
    tracker = NdiTracker(FakeLibrary([7] * 10), "/dev/ttyUSB0")
    for _ in range(4):
        assert tracker.measure() == []
    with pytest.raises(DeviceError, match=r"BX failed \(error 7\)"):
        tracker.measure()


@pytest.mark.parametrize(
    ("library", "rom", "words"),
    [
        (FakeLibrary(device=None), None, "cannot be opened; check its cable"),
        (FakeLibrary(enabled=()), None, "it has no tool; plug one in, or give --tracker-rom"),
        (FakeLibrary(refuse={"TSTART": 0x2A}), None, r"TSTART failed \(error 42\)"),
        (FakeLibrary(), "tool.txt", "description .*tool.txt was refused"),
    ],
    ids=["closed", "no tool", "refused", "no description"],
)
def test_what_cannot_be_set_up_is_one_line(tmp_path, library, rom, words):
    with pytest.raises(DeviceError, match=words) as error:
        NdiTracker(library, "/dev/ttyUSB0", roms=[tmp_path / rom] if rom else [])
    assert "\n" not in str(error.value)


def test_the_missing_extra_is_one_line(monkeypatch):
    monkeypatch.setattr(ndi, "find_spec", lambda _: None)
    with pytest.raises(
        DeviceError, match=r"tracker /dev/x: needs the package ndicapi; pip install 'tactile-bayes\[ndi\]'"
    ):
        open_tracker("ndi", "/dev/x")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--tracker-protocol", "ndi", "--tracker-rom", "none.rom"], "none.rom is not a file"),
        (["--tracker-protocol", "bird", "--tracker-rom", "none.rom"], "none.rom is not for bird"),
    ],
)
def test_a_tools_description_is_for_ndi_and_must_be_there(run_cli, tmp_path, words, said):
    done = run_cli(
        "record", "-o", "a.mcap", "--head", "loop://head", "--tracker", "loop://tracker", *words, cwd=tmp_path
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert said in done.stderr


def test_faults_have_nothing_to_act_on(run_cli, tmp_path):
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.files.scan_mcap import write_scan

    write_scan(tmp_path / "a.mcap", short_scan(0.2), provenance=Provenance("test", {}))
    of_no_effect = {
        "is spoken over a network; give --tcp": ("tracker", "--protocol", "igtlink"),
        "sends nothing by itself": ("tracker", "--protocol", "ndi", "--drop", "0.1"),
        "--hold, --hide and --breathe are a tracker's": ("head", "--hold", "3"),
    }
    for words, (device, *options) in of_no_effect.items():
        done = run_cli("emulate", device, "a.mcap", *options, cwd=tmp_path)
        assert done.returncode == 2
        assert words in done.stderr


def test_the_emulated_tracker_speaks_as_the_guide_prints_it():
    assert crc16(b"123456789") == 0xBB3D
    device = EmulatedNdi(short_scan(0.2).poses)
    assert device.respond(b"INIT:E3A5\r") == b"OKAYA896\r"
    assert device.respond(b"INIT:0000\r") == b"ERROR04%04X\r" % crc16(b"ERROR04")
    assert device.respond(b"TSTART \r").startswith(b"OKAY")
    assert device.respond(b"BX 0001\r").startswith(b"ERROR")  # no tool was enabled yet


class Wireless(EmulatedNdi):
    """Its tool has to be described by the host first."""

    _port, described = "none", b""

    def _carry_out(self, name: str, rest: str) -> str | None:
        if name == "PVWR":
            self.described += bytes.fromhex(rest[6:])
        return super()._carry_out(name, rest)


def expected(poses) -> set[tuple]:
    return {tuple(one) for one in poses.position_mm.astype(np.float32).tolist()}


@pytest.mark.long
@pytest.mark.parametrize("link", [PtyLink, lambda: TcpLink("127.0.0.1", 0)], ids=["pty", "tcp"])
def test_the_library_reads_the_emulated_tracker(link, tmp_path):
    pytest.importorskip(ndi.MODULE)
    poses, wireless = short_scan(3.0).poses, link is PtyLink
    device, line = (Wireless if wireless else EmulatedNdi)(poses), link()
    rom = tmp_path / "tool.rom"
    rom.write_bytes(bytes(range(256)) * 4)
    with serving(device, line):
        port = open_tracker("ndi", line.url, roms=[rom] if wireless else [])
        answer = TRACKERS["ndi"].check(port)
        assert answer.hello == HelloReading("Emulated NDI tracker", 0, 0, 0, 0.0)
        name = "tool" if wireless else "0A"  # this one does not know the command for the part number
        assert [*answer.tools] == [answer.tool] == [name]
        port.write(TRACKERS["ndi"].start)
        parser, found, end = TRACKERS["ndi"].parser(), [], time.monotonic() + 20.0
        while len(found) < 40 and time.monotonic() < end:
            found += [one for one in parser.feed(port.read_some(0.1)) if isinstance(one, PoseReading)]
        port.close()
    assert not wireless or device.described == rom.read_bytes()
    assert len(found) >= 40
    places = [one.position_mm for one in found]
    assert set(places) <= expected(poses)
    assert len(set(places)) == len(places)  # each frame once
    times = [one.device_ns for one in found]
    assert times == sorted(times)


@pytest.mark.long
@pytest.mark.parametrize("names", [("0A", "0B"), ("probe", "sternum")], ids=["wired", "wireless"])
def test_two_tools_are_told_apart_by_the_library_and_combined(tmp_path, names):
    pytest.importorskip(ndi.MODULE)
    scan, line, wireless = short_scan(6.0), TcpLink("127.0.0.1", 0), "probe" in names
    roms = [tmp_path / f"{name}.rom" for name in names] if wireless else []
    for rom in roms:
        rom.write_bytes(bytes(752))
    with serving((Wireless if wireless else EmulatedNdi)(scan.poses, faults=Faults(breathe_mm=20.0)), line):
        port, driver = open_tracker("ndi", line.url, roms=roms), TRACKERS["ndi"]
        with pytest.raises(UsageError, match=f"sends several tools: '{names[0]}', '{names[1]}'"):
            driver.check(port)
        answer = driver.check(port, tool=names[0], reference=names[1])
        port.write(driver.start)
        parser, follower, found = answer.parser(), Follower(answer.tool, answer.reference), []
        end = time.monotonic() + 20.0
        while len(found) < 40 and time.monotonic() < end:
            for reading in parser.feed(port.read_some(0.1)):
                if isinstance(reading, PoseReading):
                    found += [one for one, _ in follower.take(reading, time.monotonic_ns())]
        port.close()
    places = np.array([one.position_mm for one in found if isinstance(one, PoseReading)])
    assert len(places) >= 40
    nearest = np.abs(places[:, None] - scan.poses.position_mm).max(axis=2).min(axis=1)
    assert nearest.max() < 1e-3  # breathing has gone


class SpoiltNdi(EmulatedNdi):
    """One reply in ten has a byte changed on the line."""

    replies = 0

    def _poses_now(self) -> bytes:
        self.replies += 1
        good = super()._poses_now()
        return good if self.replies % 10 else good[:9] + bytes([good[9] ^ 4]) + good[10:]


@pytest.mark.long
def test_a_spoilt_reply_costs_that_pose_and_not_the_recording():
    pytest.importorskip(ndi.MODULE)
    device, line = SpoiltNdi(short_scan(3.0).poses), TcpLink("127.0.0.1", 0)
    with serving(device, line):
        port = open_tracker("ndi", line.url)
        answer = TRACKERS["ndi"].check(port)
        port.write(TRACKERS["ndi"].start)
        parser, found, end = answer.parser(), [], time.monotonic() + 20.0
        while len(found) < 60 and time.monotonic() < end:
            found += [one for one in parser.feed(port.read_some(0.1)) if isinstance(one, PoseReading)]
        port.close()
    assert len(found) >= 60
    assert device.replies > 60


def test_a_port_where_nobody_answers_is_reported():
    pytest.importorskip(ndi.MODULE)
    with pytest.raises(DeviceError, match=r"tracker /dev/nothing-here: cannot be opened; check its cable") as error:
        open_tracker("ndi", "/dev/nothing-here")
    assert "\n" not in str(error.value)


@pytest.mark.long
def test_a_recording_with_an_ndi_tracker(run_cli, tmp_path):
    pytest.importorskip(ndi.MODULE)
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.files.scan_mcap import read_scan, write_scan

    scan = short_scan(1.0)
    write_scan(tmp_path / "source.mcap", scan, provenance=Provenance("test", {}))
    lines = [PtyLink(), PtyLink()]
    with serving(EmulatedHead(scan), lines[0]), serving(EmulatedNdi(short_scan(8.0).poses), lines[1]):
        words = ["--head", lines[0].url, "--tracker", lines[1].url, "--tracker-protocol", "ndi"]
        done = run_cli("record", "-o", "a.mcap", *words, "--like", "source.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    poses = read_scan(tmp_path / "a.mcap").poses
    assert len(poses) > 30
    assert {tuple(one) for one in poses.position_mm.tolist()} <= expected(short_scan(8.0).poses)
