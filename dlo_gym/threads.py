"""Independent work in the threads of one process."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any


def n_cores() -> int:
    """Processor cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this operating system
        return os.cpu_count() or 1


class Threads:
    """``n`` threads, the caller's included. The rod's kernels let the others run meanwhile."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._pool = ThreadPoolExecutor(n - 1, "dlo_gym") if n > 1 else None

    def map(self, function: Callable[..., Any], *arguments: Sequence[Any]) -> list[Any]:
        """``list(map(function, *arguments))``: results are in order, the calls in any.

        Once a call has raised, or Ctrl-C was pressed, no further one begins; one of what they raise
        is raised when none runs any more.
        """
        calls = list(zip(*arguments, strict=True))
        if self._pool is None or len(calls) < 2:
            return [function(*call) for call in calls]
        results: list[Any] = [None] * len(calls)
        indices = iter(range(len(calls)))  # a thread that is done with one call takes the next

        def work() -> None:
            try:
                for i in indices:
                    results[i] = function(*calls[i])
            except BaseException:
                list(indices)  # leaves none to the other threads
                raise

        others = [self._pool.submit(work) for _ in range(min(self._n, len(calls)) - 1)]
        try:
            work()
            wait(others)
        finally:
            wait(others)  # after Ctrl-C too
        for other in others:
            other.result()
        return results

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
