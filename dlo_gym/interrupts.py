"""Ctrl-C in long commands: stop between two steps, then finish writing in peace."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Interrupt:
    """Whether Ctrl-C was pressed inside ``deferred_interrupt``."""

    requested: bool = False


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Note Ctrl-C instead of raising ``KeyboardInterrupt`` wherever the program happens to be.

    The block looks at ``requested`` between its steps and ends early; what it writes at its end is
    not disturbed by an impatient second Ctrl-C. Outside the main thread, which alone receives
    signals, nothing changes.
    """
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return

    def note(*_: object) -> None:
        interrupt.requested = True

    former = signal.signal(signal.SIGINT, note)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, former)
