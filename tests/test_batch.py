"""Batches give the same ordered results anywhere, name what failed and resume after a kill."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes import batch
from tactile_bayes import batch as executors
from tactile_bayes.batch import (
    BatchInterrupted,
    BatchStore,
    InlineExecutor,
    cluster_executor,
    fault_lines,
    open_executor,
    open_store,
    run_batch,
)
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.shell import interrupt_on_signals


def draw(seed: int) -> tuple[int, float]:
    """An item that carries its own seed."""
    return seed, random.Random(seed).gauss(0.0, 1.0)


def refuse_odd(item: int) -> int:
    if item % 2:
        raise BadDataError(f"item {item} is odd", way_out="give an even one")
    return item * item


def raise_unpicklable(item: int) -> int:
    class LocalError(Exception):
        pass

    raise LocalError(f"cannot\ntravel {item}")


def die_on_three(item: int) -> int:
    if item == 3:
        os._exit(1)
    return item


class ReversedExecutor(Executor):
    """Finishes its items last first, when a batch runs out of items to submit."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.held: list[tuple[Future, tuple]] = []

    def submit(self, fn, /, *args):
        future: Future = Future()
        self.held.append((future, (fn, args)))
        if len(self.held) == self.count:
            for waiting, (function, arguments) in reversed(self.held):
                waiting.set_result(function(*arguments))
        return future


EXPECTED = [draw(seed) for seed in range(12)]


# --- the same results anywhere


@pytest.mark.long_repeats
@pytest.mark.parametrize("workers", [0, 1, 2])
def test_results_do_not_depend_on_the_number_of_workers(workers):
    with open_executor(workers=workers) as executor:
        outcomes = run_batch(draw, range(12), key=str, executor=executor)
    assert [outcome.value for outcome in outcomes] == EXPECTED
    assert [outcome.key for outcome in outcomes] == [str(seed) for seed in range(12)]


@given(items=st.lists(st.integers(), unique=True, min_size=1, max_size=40))
def test_outcomes_keep_the_order_of_the_items(items):
    outcomes = run_batch(str, items, key=repr, executor=ReversedExecutor(len(items)))
    assert [outcome.key for outcome in outcomes] == [repr(item) for item in items]
    assert [outcome.value for outcome in outcomes] == [str(item) for item in items]


def test_a_batch_larger_than_the_window_is_complete(monkeypatch):
    monkeypatch.setattr(batch, "_WINDOW", 3)
    with ThreadPoolExecutor(2) as executor:
        outcomes = run_batch(draw, range(12), key=str, executor=executor)
    assert [outcome.value for outcome in outcomes] == EXPECTED


def test_no_items_no_outcomes():
    calls = []
    assert run_batch(draw, [], key=str, progress=lambda *at: calls.append(at)) == []
    assert calls == [(0, 0)]


def test_progress_counts_to_the_total():
    calls = []
    run_batch(draw, range(3), key=str, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_two_items_of_one_name_are_refused():
    with pytest.raises(BadDataError, match="called 'same'; give each its own name"):
        run_batch(draw, [1, 2], key=lambda _: "same")


# --- failures


@pytest.mark.long_repeats
@pytest.mark.parametrize("workers", [1, 2])
def test_a_failed_item_is_named_and_the_rest_kept(workers):
    with open_executor(workers=workers) as executor:
        outcomes = run_batch(refuse_odd, range(4), key=lambda item: f"case {item}", executor=executor)
    assert [outcome.value for outcome in outcomes] == [0, None, 4, None]
    assert [outcome.ok for outcome in outcomes] == [True, False, True, False]
    assert outcomes[3].key == "case 3"
    assert outcomes[3].error == "item 3 is odd; give an even one"


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_that_cannot_travel_is_still_one_line(workers):
    with open_executor(workers=workers) as executor:
        (outcome,) = run_batch(raise_unpicklable, [7], key=str, executor=executor)
    assert outcome.error == "LocalError: cannot travel 7"


def die_once(work: tuple[int, Path]) -> int:
    """Item 3 kills its worker the first time it is run, as one does who runs out of memory beside others."""
    item, folder = work
    if item == 3 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item


@pytest.mark.long
def test_a_killed_worker_costs_no_result(tmp_path):
    with open_executor(workers=2) as executor:
        outcomes = run_batch(die_once, [(i, tmp_path) for i in range(8)], key=repr, executor=executor)
    assert (tmp_path / "died").exists()
    assert [outcome.value for outcome in outcomes] == list(range(8))


@pytest.mark.long
def test_a_worker_killed_while_it_hands_over_its_result_holds_up_nobody(tmp_path, child_environment):
    """With one pipe for all workers the batch waited for the rest of the result for ever."""
    script = tmp_path / "run.py"
    script.write_text(
        textwrap.dedent(
            """
            import os, sys, time
            from pathlib import Path
            from tactile_bayes.batch import run_batch
            from tactile_bayes.batch import open_executor

            def large(item):
                (Path(sys.argv[1]) / "writing").write_text(str(os.getpid()))
                (Path(sys.argv[1]) / "writing").rename(Path(sys.argv[1]) / f"pid-{item}")
                time.sleep(0.2)
                return bytes(20_000_000)

            if __name__ == "__main__":
                with open_executor(workers=2) as executor:
                    outcomes = run_batch(large, range(3), key=str, executor=executor)
                print([len(outcome.value) for outcome in outcomes])
            """
        )
    )
    command = [sys.executable, str(script), str(tmp_path)]
    process = subprocess.Popen(command, env=child_environment, stdout=subprocess.PIPE, text=True)
    try:
        wait_until((tmp_path / "pid-0").exists)
        process.send_signal(signal.SIGSTOP)
        worker = int((tmp_path / "pid-0").read_text())
        wait_until(lambda: waits_to_write(worker))
        os.kill(worker, signal.SIGKILL)
        wait_until(lambda: not is_running(worker))
        process.send_signal(signal.SIGCONT)
        told, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert told == "[20000000, 20000000, 20000000]\n"


def waits_to_write(pid: int) -> bool:
    """Whether a process sleeps in the middle of sending: the pipe is full and nobody reads."""
    where = Path(f"/proc/{pid}/syscall").read_text().split()[0]
    return where in ("1", "44", "46", "64", "206")  # write, sendto, sendmsg of x86-64; write, sendto of arm64


@pytest.mark.long
def test_an_item_whose_worker_dies_twice_is_at_fault_and_no_other():
    with open_executor(workers=2) as executor:
        outcomes = run_batch(die_on_three, range(8), key=str, executor=executor)
    assert [outcome.value for outcome in outcomes] == [0, 1, 2, None, 4, 5, 6, 7]
    assert outcomes[3].error == batch.DIED_TWICE


@pytest.mark.long
def test_ctrl_c_carries_what_is_done_and_does_not_wait_for_workers(tmp_path):
    """The second of two workers never ends by itself; it is gone when the batch has been left."""

    def interrupt(done: int, _total: int) -> None:
        if done == 1:
            wait_until((tmp_path / "pid").exists)
            raise KeyboardInterrupt

    with open_executor(workers=2) as executor, pytest.raises(BatchInterrupted) as stop:
        run_batch(
            sleep_for_ever,
            [(0, tmp_path), (1, tmp_path)],
            key=lambda w: str(w[0]),
            executor=executor,
            progress=interrupt,
        )
    assert [(one.key, one.value) for one in stop.value.outcomes] == [("0", 0)]
    assert str(stop.value) == "1 of 2 done"
    pid = int((tmp_path / "pid").read_text())
    wait_until(lambda: not is_running(pid))


def sleep_for_ever(work: tuple[int, Path]) -> int:
    item, folder = work
    if item:
        (folder / "writing").write_text(str(os.getpid()))
        (folder / "writing").rename(folder / "pid")
        time.sleep(1e6)
    return item


def test_items_of_one_fault_share_a_line():
    outcomes = [batch.Outcome(str(i), error="lost") for i in range(5)]
    lines = fault_lines([*outcomes, batch.Outcome("x", error="odd"), batch.Outcome("y", value=1)])
    assert lines == ["0, 1, 2 (and 2 more): lost", "x: odd"]


def test_after_the_loss_of_a_cluster_nothing_more_is_handed_out(tmp_path):
    class Lost(Executor):
        """Answers twice, then is lost."""

        ahead = 4

        def __init__(self):
            self.handed = []

        def submit(self, function, /, *arguments):
            future = Future()
            self.handed.append(arguments[-1])
            if len(self.handed) > 2:
                future.cancel()
                future.set_running_or_notify_cancel()
            else:
                future.set_result(function(*arguments))
            return future

    executor = Lost()
    with open_store(tmp_path / "store", settings={}) as store:
        outcomes = run_batch(draw, range(50), key=str, executor=executor, store=store)
        assert set(store) == {"0", "1"}
    assert len(executor.handed) < 10
    assert [outcome.ok for outcome in outcomes] == [True] * 2 + [False] * 48
    assert {outcome.error for outcome in outcomes[2:]} == {batch.CLUSTER_LOST}


def test_negative_workers_are_refused():
    with pytest.raises(UsageError, match="workers is -1"):
        open_executor(workers=-1)


# --- interruption


def test_ctrl_c_keeps_what_is_done_and_goes_on_up(tmp_path):
    def interrupt_at_two(item: int) -> int:
        if item == 2:
            raise KeyboardInterrupt
        return item

    ran = []
    with open_store(tmp_path / "store", settings={}) as store, pytest.raises(KeyboardInterrupt):
        run_batch(interrupt_at_two, range(5), key=str, store=store)
    with open_store(tmp_path / "store", settings={}) as store:
        assert store == {"0": 0, "1": 1}
        outcomes = run_batch(lambda item: ran.append(item) or item, range(5), key=str, store=store)
    assert ran == [2, 3, 4]
    assert [outcome.value for outcome in outcomes] == [0, 1, 2, 3, 4]


def test_ctrl_c_cancels_what_has_not_begun():
    held: list[Future] = []

    class Never(Executor):
        def submit(self, _function, /, *_arguments):
            held.append(Future())
            return held[-1]

    def interrupt(_done: int, _total: int) -> None:
        raise KeyboardInterrupt

    executor = Never()
    with pytest.raises(KeyboardInterrupt):
        run_batch(draw, [1], key=str, executor=executor, progress=interrupt)
    assert not held  # nothing was begun

    class ThenInterrupted(Never):
        def submit(self, function, /, *arguments):
            if len(held) == 2:
                raise KeyboardInterrupt
            return super().submit(function, *arguments)

    with pytest.raises(KeyboardInterrupt):
        run_batch(draw, range(5), key=str, executor=ThenInterrupted())
    assert [future.cancelled() for future in held] == [True, True]


# --- the store


def fill(path: Path, count: int = 4) -> list:
    with open_store(path, settings={"seed": 1}) as store:
        return run_batch(draw, range(count), key=str, store=store)


def test_fresh_and_resumed_results_are_equal(tmp_path):
    fresh = fill(tmp_path / "store")
    assert fill(tmp_path / "store") == fresh
    assert [outcome.value for outcome in fresh] == [list(draw(seed)) for seed in range(4)]  # as JSON gives them back


@pytest.mark.parametrize("lost", [1, 7, 30, 80, 150])
def test_a_batch_resumes_from_a_store_cut_anywhere(tmp_path, lost):
    path = tmp_path / "store"
    whole = fill(path)
    content = path.read_bytes()
    path.write_bytes(content[:-lost])
    ran = []
    with open_store(path, settings={"seed": 1}) as store:
        have = set(store)
        outcomes = run_batch(lambda seed: ran.append(str(seed)) or draw(seed), range(4), key=str, store=store)
    assert outcomes == whole
    assert set(ran) == {"0", "1", "2", "3"} - have
    assert len(ran) >= 1
    assert path.read_bytes() == content


@given(cut=st.integers(min_value=0, max_value=10_000))
def test_any_prefix_of_a_store_resumes_to_the_same_bytes(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("cut") / "store"
    fill(path)
    content = path.read_bytes()
    path.write_bytes(content[: cut % (len(content) + 1)])
    fill(path)
    assert path.read_bytes() == content


@given(
    values=st.dictionaries(
        st.text(max_size=8),
        st.none()
        | st.floats(allow_nan=False)
        | st.text()
        | st.lists(st.integers())
        | st.dictionaries(st.text(), st.text()),
        max_size=6,
    )
)
def test_any_value_comes_back_from_the_store(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("any") / "store"
    with open_store(path, settings={}) as store:
        run_batch(values.__getitem__, values, key=lambda name: name, store=store)
    with open_store(path, settings={}) as store:
        assert store == values


def test_a_store_holds_places_of_lines_and_reads_what_they_say(tmp_path):
    path, long = tmp_path / "store", "x" * 20_000  # longer than one read
    with open_store(path, settings={}) as store:
        run_batch({"a": long, "b": 1}.__getitem__, ["a", "b"], key=str, store=store)
        del store["a"]
        assert (list(store), store.get("a")) == (["b"], None)
        store.add("a", "again")
        assert store["a"] == "again"
    data = path.read_bytes()
    assert data.count(b'"key": "a"') == 2
    with open_store(path, settings={}) as store:
        assert (store["a"], store["b"]) == ("again", 1)  # the latest line of a name counts
        path.write_bytes(data.replace(b'"value": 1', b'"value": 7'))
        with pytest.raises(ValueError, match="checksum"):
            store["b"]


def test_failed_items_are_tried_again(tmp_path):
    with open_store(tmp_path / "store", settings={}) as store:
        run_batch(refuse_odd, range(4), key=str, store=store)
        assert set(store) == {"0", "2"}
        outcomes = run_batch(draw, range(4), key=str, store=store)
    assert [outcome.ok for outcome in outcomes] == [True] * 4
    assert outcomes[0].value == 0


def test_a_result_that_is_not_json_fails_alone(tmp_path):
    with open_store(tmp_path / "store", settings={}) as store:
        outcomes = run_batch(lambda item: {1} if item else 0, [0, 1], key=str, store=store)
    assert outcomes[0].value == 0
    assert outcomes[1].error.startswith("TypeError: Object of type set")


def test_results_pass_through_the_encoder(tmp_path):
    for _ in range(2):
        with open_store(
            tmp_path / "store", settings={}, encode=lambda v: {"re": v.real}, decode=lambda v: v["re"] + 0j
        ) as store:
            (outcome,) = run_batch(complex, [2], key=str, store=store)
        assert outcome.value == 2 + 0j


def test_a_store_of_other_settings_is_refused_by_name(tmp_path):
    path = tmp_path / "store"
    fill(path)
    before = path.read_bytes()
    with (
        pytest.raises(UsageError, match=r"other settings \(seed: seed was 1, is 2\)"),
        open_store(path, settings={"seed": 2}),
    ):
        pass
    assert path.read_bytes() == before


def test_a_store_in_use_is_refused(tmp_path):
    path = tmp_path / "store"
    with (
        open_store(path, settings={}),
        pytest.raises(UsageError, match="in use by another run"),
        open_store(path, settings={}),
    ):
        pass


@pytest.mark.parametrize("content", [b"hello\n", b"half a line", b"[]\n", b'{"key": "a", "value": 1}\n', b"\xff\xfe\n"])
def test_another_file_is_refused_and_left_alone(tmp_path, content):
    path = tmp_path / "notes"
    path.write_bytes(content)
    with pytest.raises(BadDataError, match="not a store of batch results"), open_store(path, settings={}):
        pass
    assert path.read_bytes() == content


def test_a_store_of_another_schema_is_refused(tmp_path):
    path = tmp_path / "store"
    path.write_text(json.dumps({"schema": "tactile-bayes.batch/99", "settings": {}}) + "\n")
    with pytest.raises(BadDataError, match=r"schema tactile-bayes\.batch/99"), open_store(path, settings={}):
        pass


def test_a_damaged_line_is_named(tmp_path):
    path = tmp_path / "store"
    fill(path)
    lines = path.read_text().splitlines(keepends=True)
    lines[2] = lines[2][:5] + "\n"
    path.write_text("".join(lines))
    with pytest.raises(BadDataError, match="line 3 is damaged"), open_store(path, settings={"seed": 1}):
        pass


def test_a_store_is_its_owners_only(tmp_path):
    fill(tmp_path / "store")
    assert (tmp_path / "store").stat().st_mode & 0o777 == 0o600


def test_a_store_that_cannot_be_opened_says_so(tmp_path):
    with pytest.raises(UsageError, match="cannot be opened"), open_store(tmp_path / "none" / "store", settings={}):
        pass


def test_a_full_disk_stops_the_batch_in_one_line():
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    descriptor = os.open(full, os.O_RDWR)
    try:
        store = BatchStore(descriptor, full, encode=lambda v: v, decode=lambda v: v)
        with pytest.raises(UsageError, match="cannot be written"):
            run_batch(draw, range(3), key=str, store=store)
    finally:
        os.close(descriptor)


def test_a_killed_batch_resumes_and_its_workers_end(tmp_path, child_environment):
    script = tmp_path / "run.py"
    script.write_text(
        textwrap.dedent(
            """
            import os, sys, time
            from pathlib import Path
            from tactile_bayes.batch import run_batch
            from tactile_bayes.batch import BatchStore, open_store
            from tactile_bayes.batch import open_executor

            def slow(item):
                (Path(sys.argv[1]) / f"pid-{os.getpid()}").touch()
                time.sleep(0.05)
                return item * 10

            if __name__ == "__main__":
                place = Path(sys.argv[1]) / "store"
                with open_store(place, settings={}) as store, open_executor(workers=2) as executor:
                    outcomes = run_batch(slow, range(int(sys.argv[2])), key=str, executor=executor, store=store)
                print(sum(outcome.value for outcome in outcomes))
            """
        )
    )
    store = tmp_path / "store"
    command = [sys.executable, str(script), str(tmp_path)]
    process = subprocess.Popen([*command, "10000"], env=child_environment)
    try:
        wait_until(lambda: store.exists() and store.read_bytes().count(b"\n") >= 4)
    finally:
        process.kill()
        process.wait()
    workers = [int(path.name.removeprefix("pid-")) for path in tmp_path.glob("pid-*")]
    assert workers
    wait_until(lambda: not any(is_running(pid) for pid in workers))
    done = store.read_bytes().count(b"\n") - 1
    again = subprocess.run([*command, str(done + 5)], env=child_environment, capture_output=True, text=True, check=True)
    assert int(again.stdout) == sum(item * 10 for item in range(done + 5))


def wait_until(condition, *, limit_s: float = 60.0) -> None:
    for _ in range(int(limit_s / 0.02)):
        if condition():
            return
        time.sleep(0.02)
    pytest.fail("waited in vain")


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


# --- a cluster


def test_a_cluster_without_the_extra_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"tactile-bayes\[cluster\]"), open_executor(cluster="tcp://127.0.0.1:1"):
        pass


@pytest.fixture(scope="module")
def cluster(child_environment: dict[str, str]) -> Iterator[tuple[str, str]]:
    """A scheduler with one worker, and a scheduler with none: real processes on the loopback."""
    pytest.importorskip("distributed", reason="the [cluster] extra is not installed")
    here = str(Path(__file__).parent)  # a worker imports this module's functions by name
    environment = child_environment | {"PYTHONPATH": os.pathsep.join([child_environment["PYTHONPATH"], here])}
    with contextlib.ExitStack() as stack:
        schedulers = [
            stack.enter_context(running(environment, "scheduler", "--host", "127.0.0.1", "--port", "0"))
            for _ in range(2)
        ]
        addresses = [address_in(process, "Scheduler at:") for process in schedulers]
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
        worker = stack.enter_context(running(environment, "worker", addresses[0], *options))
        address_in(worker, "Registered to:")
        yield addresses[0], addresses[1]


@contextlib.contextmanager
def running(environment: dict[str, str], *command: str) -> Iterator[subprocess.Popen[str]]:
    no_dashboard = ["--no-dashboard"] if command[0] == "scheduler" else []
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_" + command[0], *command[1:], *no_dashboard],
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate()


def address_in(process: subprocess.Popen[str], label: str) -> str:
    assert process.stderr is not None
    seen = []
    for line in process.stderr:
        seen.append(line)
        if label in line:
            return line.split(label)[1].split()[0]
    pytest.fail(f"ended before it said {label!r}:\n{''.join(seen)}")


@pytest.mark.slow
def test_a_cluster_gives_the_same_results_and_names_what_failed(cluster):
    address, _ = cluster
    with open_executor(cluster=address) as executor:
        drawn = run_batch(draw, range(12), key=str, executor=executor)
        failed = run_batch(refuse_odd, range(3), key=str, executor=executor)
        (strange,) = run_batch(raise_unpicklable, [7], key=str, executor=executor)
    assert [outcome.error for outcome in drawn] == [""] * 12
    assert [outcome.value for outcome in drawn] == EXPECTED
    assert [outcome.value for outcome in failed] == [0, None, 4]
    assert failed[1].error == "item 1 is odd; give an even one"
    assert strange.error == "LocalError: cannot travel 7"


@pytest.mark.slow
def test_a_scheduler_killed_in_the_middle_is_one_line_and_what_is_done_is_kept(child_environment, tmp_path):
    pytest.importorskip("distributed", reason="the [cluster] extra is not installed")
    script = tmp_path / "run.py"
    script.write_text(
        textwrap.dedent(
            """
            import sys, time
            from tactile_bayes.batch import fault_lines, run_batch
            from tactile_bayes.batch import open_executor

            def slow(item):
                time.sleep(0.3)
                return item

            with open_executor(cluster=sys.argv[1]) as executor:
                told = lambda done, total: print(done, flush=True)
                outcomes = run_batch(slow, range(40), key=str, executor=executor, progress=told)
            print([one.value for one in outcomes if one.ok], fault_lines(outcomes))
            """
        )
    )
    with running(child_environment, "scheduler", "--host", "127.0.0.1", "--port", "0") as scheduler:
        address = address_in(scheduler, "Scheduler at:")
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
        with running(child_environment, "worker", address, *options) as worker:
            address_in(worker, "Registered to:")
            command = [sys.executable, str(script), address]
            process = subprocess.Popen(
                command, env=child_environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            assert process.stdout is not None
            while process.stdout.readline() != "3\n":
                pass
            scheduler.kill()
            output, errors = process.communicate(timeout=60)
            worker.kill()
    assert process.returncode == 0
    assert errors == ""
    kept, told = output.splitlines()[-1].split("] ", 1)
    assert kept.startswith("[0, 1, 2")
    assert re.fullmatch(rf"\['\d+, \d+, \d+ and \d+ more: {batch.CLUSTER_LOST}'\]", told)


@pytest.mark.slow
def test_a_cluster_of_another_version_is_refused(cluster, monkeypatch):
    monkeypatch.setattr(executors, "__version__", "0.0.0")
    with pytest.raises(UsageError, match="install the same version"), cluster_executor(cluster[0]):
        pass


@pytest.mark.slow
def test_a_cluster_without_workers_says_so(cluster):
    with pytest.raises(UsageError, match="has no workers; start one"), cluster_executor(cluster[1]):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "smoke://nowhere"])
def test_a_scheduler_that_does_not_answer_is_named(address):
    pytest.importorskip("distributed", reason="the [cluster] extra is not installed")
    with pytest.raises(UsageError, match="no dask scheduler answers at"), cluster_executor(address, timeout_s=0.5):
        pass


def test_the_inline_executor_holds_what_an_item_raised():
    with InlineExecutor() as executor:
        future = executor.submit(refuse_odd, 1)
    assert isinstance(future.exception(), BadDataError)


def test_an_interruption_that_an_item_lets_go_is_not_lost() -> None:
    """As compiled modules do while they are imported: a batch went on for hours after SIGTERM."""

    def deaf(item: int) -> int:
        if item == 1:
            with contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(5.0)
        return item

    before = signal.getsignal(signal.SIGTERM)
    with interrupt_on_signals(), pytest.raises(BatchInterrupted, match=r"2 of 9 done") as stop:
        run_batch(deaf, range(9), key=str)
    assert signal.getsignal(signal.SIGTERM) is before
    assert [one.value for one in stop.value.outcomes] == [0, 1]
