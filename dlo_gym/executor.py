"""Independent tasks over the cores of this machine, or over the machines of a Ray cluster.

A task is a function of a module and its arguments, and depends on nothing else: where it runs, and
how often it had to be begun anew, does not show in its result.
"""

import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from dlo_gym.exceptions import MissingExtra, WorkersLost
from dlo_gym.threads import n_cores

ATTEMPTS = 3  # at a task whose worker dies
LOOPBACK = "127.0.0.1"
CONNECTION_TIMEOUT = 10.0  # [s]


def run_tasks(
    function: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    *,
    workers: int = 0,
    ray_address: str | None = None,
) -> Iterator[tuple[int, Any]]:
    """The index and the result ``function(*tasks[index])`` of every task, as they are finished.

    Tasks whose worker dies are begun again.

    Args:
        function: of a module, so that another process can import it.
        tasks: arguments, which can be pickled.
        workers: processes on this machine; 0 for one per core, 1 for this process itself.
        ray_address: of a Ray cluster, host:port, which takes the place of these processes; "local"
            for one of ``workers`` processes that lasts as long as the tasks.

    Raises:
        WorkersLost: if the workers of a task died again and again.
        MissingExtra: if a Ray address is given and Ray is not installed.
        ValueError: if there is no Ray cluster at the address.
    """
    if workers < 0:
        raise ValueError(f"workers: expected 0 or more, got {workers}")
    n_processes = workers or n_cores()
    if ray_address is not None:
        yield from _on_ray(function, tasks, ray_address, n_processes)
    elif n_processes == 1 or len(tasks) < 2:
        for index, arguments in enumerate(tasks):
            yield index, function(*arguments)
    else:
        yield from _in_processes(function, tasks, n_processes)


def in_order(results: Iterable[tuple[int, Any]]) -> Iterator[Any]:
    """The results of ``run_tasks`` in the order of their tasks, each as soon as those before it."""
    waiting: dict[int, Any] = {}
    following = 0
    for index, result in results:
        waiting[index] = result
        while following in waiting:
            yield waiting.pop(following)
            following += 1


def _in_processes(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], n_processes: int
) -> Iterator[tuple[int, Any]]:
    context = multiprocessing.get_context("spawn")
    left, deaths = set(range(len(tasks))), 0
    while left:
        with (
            _one_thread_each(),
            ProcessPoolExecutor(min(n_processes, len(left)), context, _start_worker) as pool,
        ):
            futures: dict[Future[Any], int] = {
                pool.submit(function, *tasks[index]): index for index in sorted(left)
            }
            try:
                for future in as_completed(futures):
                    result = future.result()
                    left.remove(futures[future])
                    deaths = 0
                    yield futures[future], result
            except BrokenProcessPool as error:
                deaths += 1
                if deaths == ATTEMPTS:
                    plural = "" if len(left) == 1 else "s"
                    raise WorkersLost(
                        f"a worker process was killed {deaths} times in a row with"
                        f" {len(left)} task{plural} left, perhaps for memory; try fewer workers"
                    ) from error
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


def _on_ray(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], address: str, n_processes: int
) -> Iterator[tuple[int, Any]]:
    ray = import_ray(address)
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == "local":
        settings |= {"num_cpus": n_processes, "include_dashboard": False}
    else:
        _check_reachable(address)
    if _is_loopback(address):
        settings["_node_ip_address"] = LOOPBACK
    ray.init(address, **settings)
    try:
        remote = ray.remote(max_retries=ATTEMPTS, num_cpus=1)(function)
        running = {remote.remote(*arguments): index for index, arguments in enumerate(tasks)}
        while running:
            for reference in ray.wait(list(running))[0]:
                index = running.pop(reference)
                yield index, _result(ray, reference, index)
    finally:
        ray.shutdown()


def _result(ray: Any, reference: Any, index: int) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise WorkersLost(
            f"task {index}: its workers on the Ray cluster died {1 + ATTEMPTS} times: {error}"
        ) from error


def import_ray(address: str) -> Any:
    """Ray, told to stay on this machine where ``address`` does; it reports to nobody.

    Raises:
        MissingExtra: if it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if _is_loopback(address):  # else Ray takes 127.0.0.1 for this machine's address in its network
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        import ray
    except ModuleNotFoundError as error:
        raise MissingExtra("ray", "scale") from error
    return ray


def _check_reachable(address: str) -> None:
    """Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), CONNECTION_TIMEOUT).close()
    except (OSError, ValueError) as error:
        raise ValueError(
            "ray_address: expected the host:port of a running Ray cluster, or 'local', got"
            f" {address!r}: {error}"
        ) from error


def _is_loopback(address: str) -> bool:
    return address == "local" or address.rpartition(":")[0] in (LOOPBACK, "localhost")


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started meanwhile use one BLAS thread: they already are one per core."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_worker() -> None:
    """Ctrl-C is the parent's business, and a worker does not outlive a parent that was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()
