import os
import signal
import sys
import time
from itertools import islice
from pathlib import Path

import pytest

from dlo_gym.exceptions import DatasetError, MissingExtra, WorkersLost
from dlo_gym.executor import ATTEMPTS, import_ray, in_order, run_tasks


def squared(value: int) -> tuple[int, int]:
    return value**2, os.getpid()


def killed_at_first(folder: Path, value: int) -> int:
    """Dies by SIGKILL when it is called for the first time with an odd value."""
    mark = folder / f"{value}"
    if value % 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value**2


def always_killed(value: int) -> int:
    if value == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def refused(value: int) -> None:
    raise DatasetError(f"no {value}")


@pytest.mark.parametrize("workers", [1, 2])
def test_every_task_is_done_once_and_named_by_its_index(workers):
    found = dict(run_tasks(squared, [(i,) for i in range(9)], workers=workers))
    assert {index: square for index, (square, _) in found.items()} == {i: i**2 for i in range(9)}
    processes = {process for _, process in found.values()}
    assert (processes == {os.getpid()}) == (workers == 1)


def test_a_process_that_may_use_one_core_starts_no_other(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1}, raising=False)
    processes = {process for _, (_, process) in run_tasks(squared, [(1,), (2,)])}
    assert processes == {os.getpid()}


def test_results_in_the_order_of_their_tasks():
    came = iter([(2, "c"), (0, "a"), (1, "b"), (4, "e"), (3, "d")])
    ordered = in_order(came)
    assert next(ordered) == "a"
    assert next(came) == (1, "b")  # not read further than needed
    assert list(in_order([(2, "c"), (0, "a"), (1, "b")])) == ["a", "b", "c"]


def test_no_tasks():
    assert list(run_tasks(squared, [])) == []


def test_the_tasks_of_a_worker_that_dies_are_begun_again(tmp_path):
    tasks = [(tmp_path, i) for i in range(4)]
    assert dict(run_tasks(killed_at_first, tasks, workers=2)) == {i: i**2 for i in range(4)}
    assert len(list(tmp_path.iterdir())) == 2


def test_a_task_that_kills_every_worker_is_given_up_after_all_others():
    tasks = run_tasks(always_killed, [(i,) for i in range(4)], workers=2)
    assert dict(islice(tasks, 3)) == {0: 0, 1: 1, 3: 3}
    with pytest.raises(WorkersLost, match=f"killed {ATTEMPTS} times in a row with 1 task left"):
        next(tasks)


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_of_a_task_reach_the_caller(workers):
    with pytest.raises(DatasetError, match="no 7"):
        list(run_tasks(refused, [(7,), (7,)], workers=workers))


def test_the_environment_is_left_as_it_was(monkeypatch):
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    list(run_tasks(squared, [(1,), (2,)], workers=2))
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_negative_workers_are_refused():
    with pytest.raises(ValueError, match="workers: expected 0 or more, got -1"):
        list(run_tasks(squared, [(1,)], workers=-1))


def test_ray_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"dlo-gym\[scale\]"):
        list(run_tasks(squared, [(1,)], ray_address="local"))


def import_ray_or_skip() -> None:
    """Before anything else imports Ray, so that it keeps to loopback."""
    try:
        import_ray("local")
    except MissingExtra as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("address", ["127.0.0.1:1", "127.0.0.1", "nowhere:much"])
def test_an_address_without_a_cluster_is_refused(address):
    import_ray_or_skip()
    with pytest.raises(ValueError, match=f"ray_address: expected the host:port .* {address!r}"):
        list(run_tasks(squared, [(1,)], ray_address=address))


RAY_START = 200  # seconds a Ray node may take to start on a busy machine


@pytest.fixture
def ray_cluster(monkeypatch):
    """Two nodes of one worker each, on loopback alone; (address, the second node, cluster)."""
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", str(RAY_START))
    import_ray_or_skip()
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "node_ip_address": "127.0.0.1"}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    second = cluster.add_node(**node)
    yield cluster.address, second, cluster
    cluster.shutdown()


def slow_square(value: int) -> tuple[int, int]:
    time.sleep(0.3)
    return squared(value)


@pytest.mark.slow
@pytest.mark.timeout(900)
class TestRay:
    def test_rollouts_are_the_same_when_half_of_the_cluster_is_killed(
        self, ray_cluster, tmp_path, monkeypatch
    ):
        from dlo_gym.surrogate import rollouts as module
        from dlo_gym.surrogate.rollouts import Manifest, load_rollouts, rollouts
        from dlo_gym.surrogate.simulation import RolloutSettings

        settings = RolloutSettings(n_rollouts=60, seed=1, n_actions=1, n_elements=20, shard_size=2)
        rollouts(tmp_path / "processes", settings, workers=2)
        address, second, cluster = ray_cluster
        written, write = [], module._write_shard

        def write_and_kill(folder, shard, arrays):
            written.append(shard)
            if len(written) == 10:
                cluster.remove_node(second, allow_graceful=False)
            return write(folder, shard, arrays)

        monkeypatch.setattr(module, "_write_shard", write_and_kill)
        rollouts(tmp_path / "ray", settings, ray_address=address)
        assert sorted(written) == list(range(30))
        manifests = [Manifest.read(tmp_path / name) for name in ("processes", "ray")]
        assert manifests[0] == manifests[1]
        load_rollouts(tmp_path / "ray")

    def test_tasks_are_spread_over_both_nodes_and_survive_their_death(self, ray_cluster):
        address, second, cluster = ray_cluster
        found, processes = {}, set()
        for index, (square, process) in run_tasks(
            slow_square, [(i,) for i in range(24)], ray_address=address
        ):
            found[index] = square
            processes.add(process)
            if len(found) == 8:
                assert len(processes) >= 2
                cluster.remove_node(second, allow_graceful=False)
        assert found == {i: i**2 for i in range(24)}

    def test_errors_and_deaths_are_named(self, ray_cluster):
        address, *_ = ray_cluster
        with pytest.raises(DatasetError, match="no 7"):
            list(run_tasks(refused, [(7,)], ray_address=address))
        with pytest.raises(WorkersLost, match="task 0: its workers on the Ray cluster died"):
            list(run_tasks(always_killed, [(2,)], ray_address=address))

    def test_ray_starts_and_stops_by_itself_on_loopback(self, monkeypatch):
        psutil = pytest.importorskip("psutil")
        monkeypatch.setenv("RAY_raylet_start_wait_time_s", str(RAY_START))
        others = psutil.Process().children(recursive=True)
        tasks = run_tasks(slow_square, [(i,) for i in range(4)], workers=2, ray_address="local")
        found = [next(tasks)]
        children = [p for p in psutil.Process().children(recursive=True) if p not in others]
        listening = [
            connection.laddr.ip.removeprefix("::ffff:")
            for process in children
            for connection in process.net_connections("inet")
            if connection.status == psutil.CONN_LISTEN
        ]
        assert listening
        assert set(listening) == {"127.0.0.1"}
        found += tasks
        assert sorted(index for index, _ in found) == list(range(4))
        _, alive = psutil.wait_procs(children, timeout=60)
        assert alive == []
