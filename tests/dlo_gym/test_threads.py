"""Calls spread over threads."""

import os
import threading
import time

import pytest

from dlo_gym.threads import Threads, n_cores


def test_cores_are_those_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 4, 5}, raising=False)
    assert n_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert n_cores() == 64


@pytest.mark.parametrize("n", [1, 2, 5])
def test_results_come_in_the_order_of_the_arguments(n):
    threads = Threads(n)
    for size in (0, 1, 3, 40):
        assert threads.map(pow, range(size), [2] * size) == [i * i for i in range(size)]
    threads.close()


def test_the_calls_run_side_by_side():
    threads, meeting = Threads(3), threading.Barrier(3)
    # Passed only by three at once.
    assert sorted(threads.map(lambda _: meeting.wait(timeout=10.0), range(3))) == [0, 1, 2]
    threads.close()


@pytest.mark.parametrize("n", [1, 3])
def test_what_a_call_raises_is_raised_when_no_call_runs_any_more(n):
    threads, running = Threads(n), []

    def call(i):
        running.append(i)
        try:
            if i == 4:
                raise KeyError("the fifth")
        finally:
            running.remove(i)

    with pytest.raises(KeyError, match="the fifth"):
        threads.map(call, range(8))
    assert not running
    assert threads.map(abs, [-1, -2]) == [1, 2]
    threads.close()


@pytest.mark.parametrize("error", [KeyError, KeyboardInterrupt])
def test_once_a_call_has_raised_none_begins(error):
    threads, begun, meeting = Threads(2), [], threading.Barrier(2)

    def call(i):
        begun.append(i)
        if i < 2:
            meeting.wait(timeout=10.0)
        if threading.current_thread() is threading.main_thread():
            raise error
        time.sleep(0.3)

    with pytest.raises(error):
        threads.map(call, range(20))
    assert sorted(begun) == [0, 1]
    threads.close()
