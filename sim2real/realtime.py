"""Scheduling of the processes that stream at 500 Hz."""

import contextlib
import ctypes
import os
import resource
import sys

PRIORITY = 10
_CURRENT_AND_FUTURE_ON_FAULT = 1 | 2 | 4  # MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT of mlockall(2)


def ask_for_real_time() -> bool:
    """Asks the kernel to run this process before ordinary ones and to keep its memory; whether it
    agreed to the first.

    A servo stream that comes 100 ms late stops a robot: an ordinary process may have to wait so
    long for a core, or for a page of its code that was dropped and must be read from the disk
    again. Linux agrees for root and for users with limits ``rtprio`` and ``memlock`` in
    ``/etc/security/limits.conf``; without them all works on a machine that is not busy otherwise.
    """
    if sys.platform.startswith("linux") and _may_lock_all():
        ctypes.CDLL(None).mlockall(_CURRENT_AND_FUTURE_ON_FAULT)
    if not hasattr(os, "sched_setscheduler"):
        return False
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
        return True
    return False


def _may_lock_all() -> bool:
    """Whether there is no limit that a later allocation could fail at."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return os.geteuid() == 0 or limit == resource.RLIM_INFINITY
