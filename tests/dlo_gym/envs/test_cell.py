import numpy as np
import pytest

from dlo_gym.envs.cell import CellState, OccluderPath, SimulatedCell, sample_occluder_paths
from dlo_gym.exceptions import RenderingUnavailable, UnreachablePose
from dlo_gym.geometry.se3 import pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, RodProperties
from dlo_gym.scene.builder import SceneConfig, default_cameras

ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
APART = BoundaryPoses(pose(ALONG_X, [-0.2, 0.0, 0.34]), pose(ALONG_X, [0.2, 0.0, 0.34]))
UP = BoundaryDisplacement.from_vector([0, 0, 0.01, 0, 0, 0, 0, 0, 0.005, 0, 0, 0])


@pytest.fixture
def cell():
    scene = SceneConfig(cameras=default_cameras(0.1), n_nodes=21)
    cell = SimulatedCell(RodProperties(length=0.5), 20, scene=scene)
    yield cell
    cell.close()


def test_an_empty_cell_says_so(cell):
    with pytest.raises(ValueError, match="reset"):
        _ = cell.rod_state


def test_a_move_takes_rod_arms_and_clock_along(cell):
    cell.reset(APART)
    before = cell.joint_angles
    state = cell.move(UP)
    assert cell.stamp == pytest.approx(cell.control_step)
    np.testing.assert_allclose(state.positions[0], [-0.2, 0.0, 0.35], atol=1e-12)
    held = cell.arms.forward_kinematics(cell.joint_angles)
    np.testing.assert_allclose(held.left, cell.boundary.left, atol=1e-9)
    np.testing.assert_allclose(held.right, cell.boundary.right, atol=1e-9)
    assert 0.0 < np.abs(cell.joint_angles - before).max() < 0.2


def test_a_refused_move_changes_nothing(cell):
    cell.reset(APART)
    cell.move(UP)
    before, joint_angles = cell.rod_state, cell.joint_angles
    away = BoundaryDisplacement.from_vector([0, 0, 2.0, 0, 0, 0, 0, 0, 2.0, 0, 0, 0])
    with pytest.raises(UnreachablePose):
        cell.move(away)
    with pytest.raises(ValueError, match="overstretched"):
        cell.move(BoundaryDisplacement.from_vector([-0.2, *np.zeros(11)]))
    assert cell.rod_state is before
    assert cell.joint_angles is joint_angles
    assert cell.stamp == cell.control_step
    np.testing.assert_array_equal(cell.rod.state.positions, before.positions)


def test_a_restored_cell_goes_on_to_the_last_bit(cell):
    cell.reset(APART)
    cell.move(UP)
    saved = cell.save()
    first = [cell.move(UP).positions for _ in range(3)][-1]
    joint_angles = cell.joint_angles
    cell.restore(saved)
    assert cell.stamp == saved.stamp
    np.testing.assert_array_equal(cell.joint_angles, saved.joint_angles)
    again = [cell.move(UP).positions for _ in range(3)][-1]
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(joint_angles, cell.joint_angles)


def test_without_arms_the_clamps_float_freely():
    cell = SimulatedCell(
        RodProperties(length=0.5), 20, scene=SceneConfig(n_nodes=21), check_arms=False
    )
    cell.reset(APART)
    cell.move(BoundaryDisplacement.from_vector([0, 0, 2.0, 0, 0, 0, 0, 0, 2.0, 0, 0, 0]))
    assert cell.joint_angles is None
    assert not cell.arms_at_obstacle()


def test_an_occluder_swings_about_its_centre():
    path = OccluderPath(np.array([0.0, -0.5, 0.3]), np.array([0.1, 0.0, 0.0]), 4.0, 0.0)
    np.testing.assert_allclose(path.position(0.0), path.centre)
    np.testing.assert_allclose(path.position(1.0), path.centre + path.swing)
    np.testing.assert_allclose(path.position(3.0), path.centre - path.swing)
    np.testing.assert_allclose(path.position(4.0), path.centre, atol=1e-12)


def test_sampled_occluders_cross_the_line_of_sight_of_each_camera_in_turn():
    cameras = default_cameras()
    paths = sample_occluder_paths(np.random.default_rng(0), cameras, 4)
    for index, path in enumerate(paths):
        camera = cameras[index % 2]
        pixel = camera.project(path.centre)
        assert camera.sees(pixel)
        assert abs(path.swing @ camera.T_world_camera[:3, 2]) < 1e-9


def test_the_number_of_occluders_must_be_the_scenes(cell):
    with pytest.raises(ValueError, match="occluders: expected the path of each of 0, got 1"):
        cell.reset(APART, (OccluderPath(np.zeros(3), np.zeros(3), 1.0, 0.0),))


def test_an_occluder_in_the_way_hides_nodes_until_it_is_gone():
    cameras = default_cameras(0.1)
    scene = SceneConfig(cameras=cameras, n_nodes=21, n_occluders=1)
    cell = SimulatedCell(RodProperties(length=0.5), 20, scene=scene)
    side = cameras[0]
    centre = side.centre + 0.6 * (np.array([0.0, 0.0, 0.3]) - side.centre)
    passing = OccluderPath(centre, np.array([1.0, 0.0, 0.0]), 0.4, 0.0)
    cell.reset(APART, (passing,))
    hidden = ~cell.visibility()[0]
    assert hidden[8:13].all()
    cell.move(BoundaryDisplacement.zero())
    assert cell.visibility()[0][8:13].all()
    cell.close()


def test_the_arms_are_drawn_as_they_stand(cell):
    cell.reset(APART)
    cell.visibility()
    turned = cell.joint_angles.copy()
    turned[:, 5] -= 2 * np.pi * np.sign(turned[:, 5])
    cell.restore(CellState(cell.rod_state, turned, 0.0))
    cell.visibility()
    np.testing.assert_array_equal(cell._renderer.joint_angles, turned)


def test_views_are_taken_once_per_step(cell):
    cell.reset(APART)
    try:
        views = cell.views()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    assert cell.views() is views
    assert [view.camera.name for view in views] == ["side", "top"]
    cell.move(UP)
    later = cell.views()
    assert later[0].stamp == pytest.approx(0.1)
    assert (later[0].image != views[0].image).any()
    cell.close()
    cell.close()
    assert np.array_equal(cell.views()[0].image, later[0].image)
