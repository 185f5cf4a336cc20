"""Tasks of a dask worker that its statistical profiler does not look at (docs/decisions/0114).

The profiler keeps a tree of call stacks for each of the last 1000 seconds, which is some 400 MB for code with stacks as
deep as an estimate's. While it looks, it also holds the frames of all threads, so that objects live on after the
function that made them has returned. It looks while a thread of the worker is listed as active.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

Result = TypeVar("Result")


def unprofiled(function: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Result:
    """Call a function in a thread of a dask worker, unseen by the worker's profiler until it returns.

    Nothing has to be undone elsewhere: a client that is killed leaves the worker as it found it.
    """
    with _unlisted():
        return function(*args, **kwargs)


@contextlib.contextmanager
def _unlisted() -> Iterator[None]:
    """Take this thread from the worker's active ones, and list it again at the end, where the worker looks for it."""
    from distributed import get_worker

    worker, thread = get_worker(), threading.get_ident()
    with worker.active_threads_lock:
        key = worker.active_threads.pop(thread)
    try:
        yield
    finally:
        with worker.active_threads_lock:
            worker.active_threads[thread] = key
