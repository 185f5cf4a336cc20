"""Dask workers without their statistical profiler, for as long as a batch runs (docs/decisions/0114).

The profiler keeps a tree of call stacks for each of the last 1000 seconds, which is some 400 MB for code with stacks as
deep as an estimate's. While it looks, it also holds the frames of all threads, so that objects live on after the
function that made them has returned.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from distributed import WorkerPlugin

if TYPE_CHECKING:
    from distributed import Client, Worker

_CALLBACKS: Final = ("profile", "profile-cycle")


class WithoutProfile(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Stops a worker's profiler, and starts it again when it is removed."""

    name = "tactile-bayes-without-profile"

    def __init__(self) -> None:
        self._stopped: dict[str, Any] = {}

    def setup(self, worker: Worker) -> None:
        """Take the profiler's callbacks from the worker; one that is still starting would start them again."""
        callbacks = worker.periodic_callbacks
        self._stopped = {name: callbacks.pop(name) for name in _CALLBACKS if name in callbacks}
        for callback in self._stopped.values():
            callback.stop()

    def teardown(self, worker: Worker) -> None:
        """Give them back."""
        worker.periodic_callbacks.update(self._stopped)
        for callback in self._stopped.values():
            callback.start()


@contextlib.contextmanager
def without_profile(client: Client) -> Iterator[None]:
    """Stop the profiler of all workers of a cluster, also of those that come later, until the block ends."""
    client.register_plugin(WithoutProfile())
    try:
        yield
    finally:
        if client.status == "running":
            with contextlib.suppress(OSError):  # the scheduler was lost meanwhile
                client.unregister_worker_plugin(WithoutProfile.name)
