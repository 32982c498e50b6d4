"""500 Hz on absolute deadlines inside an asyncio loop."""

import asyncio
import ctypes
import ctypes.util
import logging
import os
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

_log = logging.getLogger(__name__)

_MOST_CAUGHT_UP = 2500  # ticks; a longer gap (a suspended machine) is left out
_KEPT = 60_000  # ticks of lateness: two minutes


class Ticker:
    """Calls a function once per period.

    Linux has timers that are files, which wake the loop on time. The loop's own timers are rounded
    up to a millisecond there, half a period; they serve elsewhere.

    Args:
        period: [s].
        tick: to be called; a missed deadline is made up for.
    """

    def __init__(self, period: float, tick: Callable[[], None]) -> None:
        self.period = period
        self._tick = tick
        self._late: deque[float] = deque(maxlen=_KEPT)
        self._missed = 0
        self._start = self._count = 0.0
        self._cpu_start, self._wall_start = time.process_time(), time.monotonic()

    def start(self) -> None:
        """Begin now, in the running loop."""
        loop = asyncio.get_running_loop()
        self._start, self._count = time.monotonic() + self.period, 0.0
        timer = _timer_file(self._start, self.period)
        if timer is None:
            loop.call_at(self._start, self._call_later, loop)
        else:
            loop.add_reader(timer, self._read_timer, timer)

    def _read_timer(self, timer: int) -> None:
        try:
            os.read(timer, 8)
        except BlockingIOError:
            return
        self._run()

    def _call_later(self, loop: asyncio.AbstractEventLoop) -> None:
        self._run()
        loop.call_at(self._start + self._count * self.period, self._call_later, loop)

    def _run(self) -> None:
        late = time.monotonic() - (self._start + self._count * self.period)
        self._late.append(late)
        due = int(late / self.period) + 1
        if due > _MOST_CAUGHT_UP:
            _log.warning("%d ticks late, left out", due)
            self._count += due - 1
            due = 1
        self._missed += due - 1
        for _ in range(due):
            self._tick()
        self._count += due

    def timing(self) -> dict[str, Any]:
        """Lateness of the ticks [ms] and the share of a core used, since the last question."""
        late = 1e3 * np.array(self._late) if self._late else np.zeros(1)
        cpu, wall = time.process_time(), time.monotonic()
        timing = {
            "ticks": len(self._late),
            "late_p50_ms": round(float(np.quantile(late, 0.5)), 4),
            "late_p99_ms": round(float(np.quantile(late, 0.99)), 4),
            "late_max_ms": round(float(late.max()), 4),
            "missed": self._missed,
            "cpu_share": round((cpu - self._cpu_start) / max(wall - self._wall_start, 1e-9), 4),
        }
        self._late.clear()
        self._missed = 0
        self._cpu_start, self._wall_start = cpu, wall
        return timing


class _TimeSpec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _TimerSpec(ctypes.Structure):
    _fields_ = (("interval", _TimeSpec), ("first", _TimeSpec))


def _timer_file(first: float, period: float) -> int | None:
    """A file that becomes readable every ``period`` from ``first`` on; None where there is none."""
    if not sys.platform.startswith("linux"):
        return None
    libc = ctypes.CDLL(None, use_errno=True)
    absolute, clock_monotonic = 1, 1
    timer = libc.timerfd_create(clock_monotonic, os.O_NONBLOCK | os.O_CLOEXEC)
    if timer < 0:
        return None
    spec = _TimerSpec(_time_spec(period), _time_spec(first))
    if libc.timerfd_settime(timer, absolute, ctypes.byref(spec), None) < 0:
        os.close(timer)
        return None
    return timer


def _time_spec(seconds: float) -> _TimeSpec:
    whole = int(seconds)
    return _TimeSpec(whole, round((seconds - whole) * 1e9))
