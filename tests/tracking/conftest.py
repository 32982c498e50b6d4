import os
from pathlib import Path

import pytest

from dlo_gym.geometry import CameraModel
from dlo_gym.rod import RodProperties
from dlo_gym.rod.rod import CosseratRod
from tests.tracking.drawing import LENGTH, RADIUS, clamps


@pytest.fixture(scope="session")
def cameras():
    side = CameraModel.looking_at("side", (0.05, -1.05, 0.42), (0, 0, 0.27))
    top = CameraModel.looking_at("top", (0.02, -0.1, 1.25), (0, 0, 0.25))
    third = CameraModel.looking_at("third", (-0.6, -0.7, 0.8), (0, 0, 0.27))
    return tuple(camera.scaled(0.5) for camera in (side, top, third))


@pytest.fixture(scope="session")
def properties():
    return RodProperties(length=LENGTH, radius=RADIUS)


@pytest.fixture(scope="session")
def hanging(properties):
    return CosseratRod(properties).settle(clamps()).positions


@pytest.fixture(scope="session")
def exp1():
    default = Path(__file__).parents[2].parent / "shared" / "data"
    path = Path(os.environ.get("DLO_DATA", default)) / "recordings" / "exp1"
    if not path.is_dir():
        pytest.skip(f"no recording at {path}; set DLO_DATA")
    return path
