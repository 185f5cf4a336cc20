"""Bring the tracker's times onto the head's clock."""

from __future__ import annotations

from typing import Final

_WINDOW_NS: Final = 2_000_000_000


class ArrivalClock:
    """How far a device's clock is from the host's, from when its records arrive.

    A record arrives at ``device time + offset + delay`` with a delay that is never negative: the least difference of
    the last seconds is the offset, and the rest is delay. It follows clocks that drift apart.
    """

    def __init__(self) -> None:
        self._begun_ns: int | None = None
        self._last = self._now = 0

    @property
    def known(self) -> bool:
        """Whether anything has arrived."""
        return self._begun_ns is not None

    @property
    def offset_ns(self) -> int:
        """Host time of device time 0."""
        return min(self._last, self._now)

    def observe(self, device_ns: int, host_ns: int) -> None:
        """Take one record's times."""
        difference = host_ns - device_ns
        if self._begun_ns is None:
            self._begun_ns, self._last, self._now = host_ns, difference, difference
        elif host_ns - self._begun_ns > _WINDOW_NS:
            self._begun_ns, self._last, self._now = host_ns, self._now, difference
        else:
            self._now = min(self._now, difference)


class PoseClock:
    """The time of each pose on the head's clock, never running backwards.

    Parameters
    ----------
    shared
        Both devices count from one zero (they are synchronised by wire, or one program emulates both): the tracker's
        own time is taken as it is. Otherwise poses are placed by when they and the frames arrive; what is then left is
        the tracker's constant latency, which ``map --latency-ms`` takes away.
    """

    def __init__(self, *, shared: bool) -> None:
        self.head = ArrivalClock()
        self._tracker = ArrivalClock()
        self._shared = shared
        self._last_ns = 0

    def place(self, device_ns: int | None, host_ns: int) -> int | None:
        """Head time of a pose in ns; None before the first frame has come, or when it would lie before the last."""
        if self._shared:
            time_ns = device_ns
        else:
            time_ns = self._by_arrival(device_ns, host_ns)
            if time_ns is not None:
                time_ns = max(time_ns, self._last_ns)
        if time_ns is None or time_ns < self._last_ns:
            return None
        self._last_ns = time_ns
        return time_ns

    def _by_arrival(self, device_ns: int | None, host_ns: int) -> int | None:
        moment_ns = host_ns
        if device_ns is not None:
            self._tracker.observe(device_ns, host_ns)
            moment_ns = device_ns + self._tracker.offset_ns
        if not self.head.known:
            return None
        time_ns = moment_ns - self.head.offset_ns
        return time_ns if time_ns >= 0 else None
