"""What cannot be right is refused by name, with what was expected and what came."""

import numpy as np
import pytest

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    Box,
    Capsule,
    CosseratRod,
    Plane,
    RodProperties,
    Sphere,
)
from dlo_gym.rod.initial_shapes import arc, catenary, hanging, random_boundary, straight

LENGTH = 0.5
ALONG_X = frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
LEFT, RIGHT = (pose(ALONG_X, [x, 0.0, 0.3]) for x in (0.0, 0.4))
HELD = BoundaryPoses(LEFT, RIGHT)
STILL = BoundaryDisplacement.zero()
ONE_STILL = BoundaryDisplacement(np.zeros(6))
NAN = np.full((51, 3), np.nan)


def rod(**options) -> CosseratRod:
    return CosseratRod(RodProperties(LENGTH), **options)


def settled(**options) -> CosseratRod:
    settled = rod(**options)
    settled.settle(HELD)
    return settled


def far(x: float) -> BoundaryPoses:
    return BoundaryPoses(LEFT, pose(ALONG_X, [x, 0.0, 0.3]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": -1.0}, r"length: expected a positive length \[m\], got -1.0"),
        ({"length": "long"}, "length: expected a positive length .*, got 'long'"),
        ({"length": np.inf}, "length: expected a positive length .*, got inf"),
        ({"radius": 0.0}, "radius: expected a positive number .*, got 0.0"),
        ({"radius": "thin"}, "radius: expected a positive number .*, got 'thin'"),
        ({"youngs_modulus": np.nan}, "youngs_modulus: expected a positive number .*, got nan"),
        ({"youngs_modulus": -1e6}, "youngs_modulus: expected a positive number .*, got -1000000.0"),
        ({"density": -1.0}, "density: expected a positive number .*, got -1.0"),
        ({"EI": 0.0}, "EI: expected a positive number .*, got 0.0"),
        ({"GJ": -1.0}, "GJ: expected a positive number .*, got -1.0"),
        ({"EA": np.inf}, "EA: expected a positive number .*, got inf"),
        ({"kGA": np.nan}, "kGA: expected a positive number .*, got nan"),
        ({"mass_per_length": 0.0}, "mass_per_length: expected a positive number .*, got 0.0"),
        ({"poisson_ratio": 0.7}, "poisson_ratio: expected -1 < nu <= 0.5, got 0.7"),
        ({"poisson_ratio": None}, "poisson_ratio: expected -1 < nu <= 0.5, got None"),
        ({"external_damping": -1.0}, "external_damping: expected zero or a positive .*, got -1.0"),
        ({"internal_damping": np.nan}, "internal_damping: expected zero or a positive .*, got nan"),
        ({"yield_curvature": 0.0}, "yield_curvature: expected a positive number .*, got 0.0"),
        ({"yield_curvature": 2.0, "hardening": 1.0}, "hardening: expected 0 <= .* < 1, got 1.0"),
        ({"hardening": 0.1}, "hardening: expected with a yield_curvature only.*, got 0.1 and None"),
        ({"creep": -0.1}, "creep: expected 0 <= creep < 1, got -0.1"),
        ({"relaxation_time": 0.0}, r"relaxation_time: expected a positive time \[s\], got 0.0"),
        (
            {"rest_curvature": (0.0, 1.0)},
            r"rest_curvature: expected .* \(3,\) .*, got shape \(2,\)",
        ),
        ({"rest_curvature": (0.0, 1.0, np.nan)}, "rest_curvature: expected finite values"),
        ({"density": np.ones(7)}, "density: expected one value per element, 50, got 7"),
        ({"rest_curvature": np.ones((50, 3))}, "rest_curvature: expected 49 rows, got 50"),
        ({"radius": 0.011}, "radius: expected at most an element's length, 0.01 m, got 0.011 m"),
        ({"radius": np.linspace(0.001, 0.02, 50)}, "radius: expected at most .*, got 0.02 m"),
    ],
)
def test_impossible_materials(options, message):
    with pytest.raises(ValueError, match=message):
        CosseratRod(RodProperties(**{"length": LENGTH, **options}), 50)


REFUSED = {
    "number of elements": (lambda: rod(n_elements=2.5), "n_elements: expected an integer .*2.5"),
    "one element": (lambda: rod(n_elements=1), "n_elements: expected an integer of at least 2"),
    "planar gravity": (lambda: rod(gravity=(0.0, -9.81)), "gravity: expected three finite"),
    "infinite gravity": (lambda: rod(gravity=(0, 0, np.inf)), "gravity: expected three finite"),
    "kind of clamp": (lambda: rod(clamp="edge"), "clamp: expected 'element' or 'node', got 'edge'"),
    "friction": (lambda: rod(friction=-0.1), "friction: expected .* at least 0, got -0.1"),
    "no obstacle": (
        lambda: rod(obstacles=[Plane(), "wall"]),
        r"obstacles\[1\]: expected a Plane, Box, Sphere or Capsule, got 'wall'",
    ),
    "box": (lambda: Box(np.eye(4), (0.1, 0.0, 0.1)), "half_size: expected three positive"),
    "sphere": (lambda: Sphere.at([0, 0, 0], -0.1), "sphere radius: expected a positive .*-0.1"),
    "capsule": (
        lambda: Capsule.between([0, 0, 0], [0, 0, 0], 0.1),
        "end - start: expected a finite vector",
    ),
    "thin capsule": (
        lambda: Capsule.between([0, 0, 0], [0, 0, 1], 0.0),
        "capsule radius: expected a positive .*0.0",
    ),
    "plane": (lambda: Plane.through([0, 0, 0], [0, 0, 0]), "normal: expected a finite vector"),
    "skewed plane": (lambda: Plane(2.0 * np.eye(4)), "plane pose: expected a rigid transform"),
    "clamp pose": (lambda: BoundaryPoses(np.eye(3)), "clamp left: expected a pose of shape"),
    "skewed clamp": (
        lambda: BoundaryPoses(LEFT, np.diag([1.0, 1.0, -1.0, 1.0])),
        "clamp right: expected a rigid transform",
    ),
    "displacement": (
        lambda: BoundaryDisplacement(np.zeros(5)),
        "displacement left: expected 6 finite numbers",
    ),
    "displacement vector": (
        lambda: BoundaryDisplacement.from_vector(np.zeros(7)),
        r"displacement: expected 6 or 12 numbers, got shape \(7,\)",
    ),
    "clamps too far apart": (
        lambda: rod().settle(far(0.6)),
        "overstretched: the clamps would be 0.6000 m apart, the rod is 0.5000 m long",
    ),
    "clamp in an obstacle": (
        lambda: rod(obstacles=[Sphere.at([0.4, 0, 0.3], 0.05)]).settle(HELD),
        r"clamp right: expected outside of obstacles\[0\], got Sphere overlapping .* 0.053 m",
    ),
    "obstacle put on a clamp": (
        lambda: settled().set_obstacles([Plane.through([0, 0, 0.31], [0, 0, 1])]),
        r"clamp left: expected outside of obstacles\[0\], got Plane",
    ),
    "clamp moved into an obstacle": (
        lambda: settled(obstacles=[Plane()]).move(
            BoundaryDisplacement(np.array([0, 0, -0.31, 0, 0, 0]), np.zeros(6))
        ),
        r"clamp left: expected outside of obstacles\[0\], got Plane",
    ),
    "clamp driven into an obstacle": (
        lambda: settled(obstacles=[Plane()]).advance(
            BoundaryDisplacement(np.array([0, 0, -0.31, 0, 0, 0]), np.zeros(6)), 0.1
        ),
        r"clamp left: expected outside of obstacles\[0\], got Plane",
    ),
    "start": (
        lambda: rod().settle(HELD, np.zeros((5, 3))),
        r"start: expected a finite centerline of shape \(51, 3\), got shape \(5, 3\)",
    ),
    "infinite start": (lambda: rod().settle(HELD, NAN), "start: expected a finite centerline"),
    "loads": (
        lambda: rod().apply_forces(np.zeros((50, 3))),
        r"forces: expected finite values of shape \(51, 3\), got \(50, 3\)",
    ),
    "infinite loads": (lambda: rod().apply_forces(NAN), "forces: expected finite values"),
    "state before settling": (lambda: rod().state, r"state: .*call settle\(boundary\) first"),
    "move before settling": (lambda: rod().move(STILL), r"move: .*call settle\(boundary\) first"),
    "advance before settling": (lambda: rod().advance(STILL, 0.1), r"advance: .*call settle"),
    "sensitivity before settling": (lambda: rod().sensitivity(), r"sensitivity: .*call settle"),
    "move of one clamp of two": (
        lambda: settled().move(ONE_STILL),
        "displacement: must move the right clamp exactly if it exists, got right=None",
    ),
    "other obstacles": (
        lambda: settled(obstacles=[Plane()]).move(STILL, obstacles=[]),
        "obstacles: expected the rod's own bodies",
    ),
    "state of another rod": (
        lambda: rod(n_elements=20).restore(settled().state),
        "state: expected 21 nodes, got 51",
    ),
    "duration": (
        lambda: settled().advance(STILL, -0.1),
        r"duration: expected a positive time \[s\], got -0.1",
    ),
    "dt": (lambda: settled().advance(STILL, 0.1, dt=0.0), "dt: expected a positive time .*0.0"),
    "dt that is none": (
        lambda: settled().advance(STILL, 0.1, dt=np.nan),
        "dt: expected a positive time .*nan",
    ),
    "order": (
        lambda: settled().advance(STILL, 0.1, order=3),
        "order: expected 1 or 2, got 3",
    ),
    "tolerance": (
        lambda: settled().advance(STILL, 0.1, tolerance=0.0),
        r"tolerance: expected None or a positive length \[m\], got 0.0",
    ),
    "second order in contact": (
        lambda: settled(obstacles=[Plane()]).advance(STILL, 0.1, order=2),
        "order, tolerance: expected order 1 and no tolerance .* got 2 and None",
    ),
    "tolerance in contact": (
        lambda: settled(self_contact=True).advance(STILL, 0.1, tolerance=1e-4),
        "order, tolerance: expected order 1 and no tolerance .* got None and 0.0001",
    ),
    "straight": (lambda: straight(LEFT, -1.0, 5), "length: expected a positive length .*-1.0"),
    "one node": (lambda: straight(LEFT, 1.0, 1), "n_nodes: expected at least 2, got 1"),
    "arc": (lambda: arc(LEFT, 0.5, 0.0, 5), "angle: expected other than zero"),
    "catenary": (
        lambda: catenary([0, 0, 0], [1, 0, 0], 0.5, 5),
        "start, end: expected points closer than the length 0.5 m, got 1 m",
    ),
    "hanging": (lambda: hanging(HELD, np.nan, 5), "length: expected a positive length .*nan"),
    "random clamps": (
        lambda: random_boundary(np.random.default_rng(0), 0.0),
        "length: expected a positive length .*0.0",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_right_is_named(case):
    attempt, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        attempt()


@pytest.mark.parametrize("call", ["settle", "move", "advance", "set_obstacles"])
def test_divergence_carries_the_last_good_state(call, monkeypatch):
    lost = settled(obstacles=[Plane()] if call == "advance" else [])
    before = lost.state
    shift = BoundaryDisplacement(np.zeros(6), np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0]))
    calls = {
        "settle": lambda: lost.settle(far(0.3)),
        "move": lambda: lost.move(shift),
        "advance": lambda: lost.advance(shift, 0.1),
        "set_obstacles": lambda: lost.set_obstacles([Plane()]),
    }
    monkeypatch.setattr(lost, "_bounds", lost._bounds._replace(bend=1e-9))
    with pytest.raises(RodDiverged) as caught:
        calls[call]()
    for state in (caught.value.last_good, lost.state):
        np.testing.assert_array_equal(state.positions, before.positions)
        np.testing.assert_array_equal(state.boundary.right, RIGHT)


def test_the_first_settling_has_no_last_good_state(monkeypatch):
    lost = rod()
    monkeypatch.setattr(lost, "_bounds", lost._bounds._replace(bend=1e-9))
    with pytest.raises(RodDiverged) as caught:
        lost.settle(HELD)
    assert caught.value.last_good is None
    with pytest.raises(ValueError, match="settle"):
        _ = lost.state
