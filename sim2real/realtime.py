"""Scheduling of the processes that stream at 500 Hz."""

import contextlib
import os

PRIORITY = 10


def ask_for_real_time() -> bool:
    """Asks the kernel to run this process before ordinary ones; whether it agreed.

    A servo stream that comes 100 ms late stops a robot. Linux agrees for root and for users with
    an ``rtprio`` limit in ``/etc/security/limits.conf``; without it all works on a machine that
    is not busy otherwise.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
        return True
    return False
