import numpy as np
import pytest

from dlo_gym.envs.cell import SimulatedCell
from dlo_gym.envs.observers import PrivilegedObserver, make_observer
from dlo_gym.geometry.se3 import pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, RodProperties
from dlo_gym.scene.builder import SceneConfig

ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
APART = BoundaryPoses(pose(ALONG_X, [-0.2, 0.0, 0.34]), pose(ALONG_X, [0.2, 0.0, 0.34]))


def test_the_privileged_observer_reads_the_true_state():
    cell = SimulatedCell(RodProperties(length=0.5), 20, scene=SceneConfig(n_nodes=21))
    cell.reset(APART)
    observer = PrivilegedObserver()
    estimate = observer.reset(cell)
    np.testing.assert_array_equal(estimate.centerline, cell.rod_state.positions)
    assert estimate.centerline is not cell.rod_state.positions
    assert estimate.visible.shape == (0, 21)
    displacement = BoundaryDisplacement.from_vector([0.0, 0.01, *np.zeros(10)])
    cell.move(displacement)
    estimate = observer.update(cell, displacement)
    np.testing.assert_array_equal(estimate.centerline, cell.rod_state.positions)
    assert estimate.stamp == cell.stamp


def test_observers_are_made_by_name():
    assert isinstance(make_observer("privileged", {}), PrivilegedObserver)
    by_name = make_observer("dlo_gym.envs.observers:PrivilegedObserver", {})
    assert isinstance(by_name, PrivilegedObserver)


@pytest.mark.parametrize("name", ["no_such_module:Observer", "dlo_gym.envs.observers:NoSuchClass"])
def test_an_observer_that_does_not_exist_is_named(name):
    with pytest.raises(ValueError, match=f"observer: cannot load '{name}'"):
        make_observer(name, {})


def test_options_that_an_observer_does_not_take_are_refused():
    with pytest.raises(ValueError, match="observer_options.*privileged.*blur"):
        make_observer("privileged", {"blur": 1})
