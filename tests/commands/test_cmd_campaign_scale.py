"""Campaigns of many exams: blocks, digests that are kept, pages that stay small, exams and copies in object stores."""

from __future__ import annotations

import html
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from campaign_files import FAST, ROWS, contents, rows_of, steps, write_study, write_table
from in_process import run_here

from tactile_bayes.campaigns import inputs as campaign_inputs
from tactile_bayes.campaigns import report as campaign_report
from tactile_bayes.campaigns import run as campaigns
from tactile_bayes.files import reading


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study and the output of one run."""
    folder = tmp_path_factory.mktemp("study")
    write_study(folder)
    write_table(folder / "exams.csv")
    done = campaign(folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def own(undisturbed: Path, tmp_path: Path) -> Path:
    """A copy of the study with its output."""
    return shutil.copytree(undisturbed, tmp_path / "study")


def campaign(folder: Path, *more: object) -> subprocess.CompletedProcess[str]:
    return run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, *more, cwd=folder)


@pytest.mark.long
def test_blocks_of_any_size_give_the_same_bytes_and_show_exams_whole(
    undisturbed: Path, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(own / "out")
    monkeypatch.setattr(campaigns, "_BLOCK", 2)
    campaign(own)
    assert contents(own / "out") == contents(undisturbed / "out")
    begun = steps(own / "out")
    assert begun[:4] == ["map 07.v1.m1.r1", "map 07.v1.m1.r2", "estimate 07.v1.m1.r1", "estimate 07.v1.m1.r2"]


def scans(read: list[Path]) -> list[str]:
    """Names of the scans among files that were read; results of steps are read too."""
    return [path.name for path in read if path.suffix == ".mcap"]


@pytest.mark.long
def test_a_file_is_read_again_only_when_it_was_written_to_or_replaced(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign_inputs, "_SETTLED_S", -1.0)  # files of this test are new
    campaign(own)
    read: list[Path] = []
    digest_of = campaign_inputs.sha256
    monkeypatch.setattr(campaign_inputs, "sha256", lambda path: read.append(path) or digest_of(path))
    campaign(own)
    assert not scans(read)
    scan = own / "scans" / "07-a.mcap"
    known = scan.stat()
    data = bytearray(scan.read_bytes())
    data[len(data) // 2] ^= 0xFF
    scan.write_bytes(data)
    os.utime(scan, ns=(known.st_atime_ns, known.st_mtime_ns))  # same size and time of writing
    done = campaign(own)
    assert scans(read) == ["07-a.mcap"]
    assert "failed: 07.v1.m1.r1: map: is damaged" in done.stderr


@pytest.mark.long
def test_files_changed_a_moment_ago_are_always_read(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []
    digest_of = campaign_inputs.sha256
    monkeypatch.setattr(campaign_inputs, "sha256", lambda path: read.append(path) or digest_of(path))
    campaign(own)
    assert len(scans(read)) == len(ROWS)


@pytest.mark.long
def test_a_disk_that_is_away_costs_nothing_that_is_done(own: Path) -> None:
    before = contents(own / "out")
    (own / "scans").rename(own / "away")
    done = campaign(own)
    assert "0 sized, 0 without a size, 6 failed" in done.stdout
    after = contents(own / "out")
    assert {name for name in before if name.startswith("exams/")} <= set(after)
    (own / "away").rename(own / "scans")
    done = campaign(own)
    assert "2 steps run, 15 kept from earlier runs" in done.stdout
    assert contents(own / "out") == before


@pytest.mark.long
def test_a_large_contact_sheet_shows_the_worst_and_names_its_pictures(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign_report, "_MOST_INLINE", 3)
    monkeypatch.setattr(campaign_report, "_MOST_ROWS", 3)
    campaign(own)
    page = (own / "out" / "index.html").read_text()
    names = re.findall(r'<th scope="row">(.*?)<br>', page)
    assert names == ["12", "11", "07"]  # which failed, which has no size, of which one exam failed
    assert "Here are the 3 to be looked at first; all are in exams_done.csv and failures.csv." in page
    pictures = re.findall(r'<img [^>]*src="(.*?)"', page)
    assert pictures
    assert all((own / "out" / name).read_text().startswith("<svg ") for name in pictures)
    assert "img-src 'self' file:" in html.unescape(page)
    assert "data:image" not in page


@pytest.mark.long
def test_interrupted_and_planned_counts_are_of_the_whole_campaign(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaigns, "_BLOCK", 2)
    done = campaign(own, "--seed", 2, "--dry-run")
    failed = "(07.v1.m1.r3, 12.v1.m1.r1)"
    assert f"map: 2 to do {failed}, 4 done\nestimate: 6 to do, 0 done\npage: 6 to do, 0 done\npool: 4" in done.stdout


# --- object stores


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A store in this process's memory that answers for s3://."""
    fsspec = pytest.importorskip("fsspec", reason="the [cloud] extra is not installed")
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]

    class Bucket:
        """Takes addresses as they are."""

        def __getattr__(self, name: str) -> Any:
            def call(first: str, *more: Any, **named: Any) -> Any:
                names = [one.removeprefix("s3://") if isinstance(one, str) else one for one in (first, *more)]
                return getattr(memory, name)(*names, **named)

            return call

        def info(self, address: str) -> dict[str, Any]:
            known = memory.info(address.removeprefix("s3://"))
            return {"size": known["size"], "ETag": hash(memory.cat(known["name"])), "LastModified": "now"}

        def find(self, address: str) -> list[str]:
            return [name.lstrip("/") for name in memory.find(address.removeprefix("s3://"))]

    monkeypatch.setattr(reading, "_store", lambda _address: Bucket())
    return memory


@pytest.mark.long
def test_exams_in_a_store_give_what_local_ones_give_and_are_copied_there(
    undisturbed: Path, tmp_path: Path, store: Any
) -> None:
    for path in (undisturbed / "scans").iterdir():
        store.pipe(f"/trial/scans/{path.name}", path.read_bytes())
    done = run_here("campaign", "init", "s3://trial/scans", "-o", "exams.csv", cwd=tmp_path)
    assert done.stdout.startswith("exams.csv: 6 exams of 4 patients\n"), done.stderr
    write_table(tmp_path / "exams.csv", [(f"s3://trial/{file}", *rest) for file, *rest in ROWS])
    planned = campaign(tmp_path, "--copy-to", "s3://trial/out/", "--dry-run")
    assert "map: 6 to do, 0 done\nestimate: 6 to do, 0 done\ncopy: 16 to do, 0 done" in planned.stdout, planned.stdout
    assert not store.exists("/trial/out")
    done = campaign(tmp_path, "--copy-to", "s3://trial/out/")
    assert "3 sized, 1 without a size, 2 failed" in done.stdout, done.stderr
    there = {name.removeprefix("/trial/out/"): store.cat(name) for name in store.find("/trial/out")}
    here = contents(tmp_path / "out")
    assert {name: data for name, data in there.items() if name != "campaign.journal"} == here
    local = contents(undisturbed / "out")
    assert {name: here[name] for name in here if "/" in name} == {name: local[name] for name in local if "/" in name}
    assert here["trial.csv"] == local["trial.csv"]
    again = campaign(tmp_path, "--copy-to", "s3://trial/out")
    assert "2 steps run, 26 kept from earlier runs" in again.stdout  # 4 + 4 + 4 + 3 steps, copies of 4 + 4 + 3 folders


@pytest.mark.usefixtures("store")
def test_a_store_that_does_not_answer_ends_the_run_and_a_missing_file_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_table(tmp_path / "exams.csv", [("s3://trial/gone.mcap", "07", 1, "left")])
    done = campaign(tmp_path)
    assert "0 sized, 0 without a size, 1 failed" in done.stdout
    (row,) = rows_of(tmp_path / "out" / "failures.csv")
    assert row["reason"] == "cannot be read (there is no such file); check address and credentials"

    def away(_address: str) -> Any:
        raise ConnectionError("Could not connect to https://store/trial/gone.mcap?X-Amz-Signature=secret")

    monkeypatch.setattr(reading, "_store", away)
    done = campaign(tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "check network and credentials, then run again" in done.stderr
    assert "secret" not in done.stderr


@pytest.mark.parametrize("address", ["s3://key:secret@bucket/a.mcap", "s3://bucket:9000/a.mcap", "s3:///a.mcap"])
def test_an_address_that_may_hold_a_password_is_refused(address: str, tmp_path: Path) -> None:
    write_table(tmp_path / "exams.csv", [(address, "07", 1, "left")])
    done = campaign(tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "no user, port or password in it" in done.stderr
    assert "secret" not in done.stderr


def test_a_store_without_its_package_says_which(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    done = run_here("campaign", "init", "s3://trial/scans", "-o", "exams.csv", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "pip install 'tactile-bayes[cloud]'" in done.stderr


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, child_environment: dict[str, str]) -> Iterator[Any]:
    """An S3 server on the loopback."""
    pytest.importorskip("moto", reason="moto[server] is not installed")
    s3fs = pytest.importorskip("s3fs", reason="the [cloud] extra is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
        env=child_environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    named = {"ACCESS_KEY_ID": "a-key", "SECRET_ACCESS_KEY": "a-secret", "DEFAULT_REGION": "us-east-1"}
    for name, value in {**named, "ENDPOINT_URL": f"http://127.0.0.1:{port}"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    try:
        for _ in range(300):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        s3fs.S3FileSystem.clear_instance_cache()
        bucket = s3fs.S3FileSystem(use_listings_cache=False)
        bucket.mkdir("trial")
        yield bucket
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_an_s3_server_takes_part_and_no_key_is_written_down(undisturbed: Path, tmp_path: Path, server: Any) -> None:
    for path in (undisturbed / "scans").iterdir():
        server.put_file(str(path), f"trial/scans/{path.name}")
    write_table(tmp_path / "exams.csv", [(f"s3://trial/{file}", *rest) for file, *rest in ROWS])
    done = campaign(tmp_path, "--copy-to", "s3://trial/out")
    assert done.returncode == 0, done.stderr
    assert "3 sized, 1 without a size, 2 failed" in done.stdout, done.stderr
    here = contents(tmp_path / "out")
    assert here["trial.csv"] == contents(undisturbed / "out")["trial.csv"]
    assert all(server.cat(f"trial/out/{name}") == data for name, data in here.items())
    said = done.stdout + done.stderr + (tmp_path / "out" / "campaign.journal").read_text()
    assert "a-secret" not in said
    assert not [name for name, data in here.items() if b"a-secret" in data or b"a-key" in data]
