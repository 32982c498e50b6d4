"""Calls spread over threads."""

import threading

import pytest

from dlo_gym.envs.threads import Threads, n_cores


def test_there_is_a_core():
    assert n_cores() >= 1


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
