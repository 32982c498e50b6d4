"""Between a calibration and the cell file: what is saved, and the hash that tells of changes."""

import hashlib
import json
from datetime import datetime
from typing import Any

import numpy as np

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, log_so3
from sim2real.calibration.solve import CellCalibration
from sim2real.config import CellConfig

_DIGITS = 9  # nanometres


def numbers_digest(config: CellConfig) -> str:
    """SHA-256 (hex) over every number that a calibration holds for: cameras, bases, tool points."""
    numbers = {
        "cameras": {
            name: _listed(
                camera.width_px,
                camera.height_px,
                *camera.intrinsics_px,
                *camera.distortion,
                *camera.position_m,
                *camera.rotation_rad,
            )
            for name, camera in sorted(config.cameras.items())
        },
        "arms": {
            side: _listed(
                *arm.base_position_m,
                *arm.base_rotation_rad,
                *arm.tcp_position_m,
                *arm.tcp_rotation_rad,
            )
            for side, arm in sorted(config.arms.items())
        },
    }
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()


def changed_since_calibration(config: CellConfig) -> bool:
    """Whether a number was changed after the calibration that the file tells of.

    Raises:
        ValueError: if the file tells of none.
    """
    if config.calibration is None:
        raise ValueError(
            f"cell {config.name!r} was never calibrated; run  dlo robot calibrate  first"
        )
    return config.calibration.hash.partition(":")[0] != numbers_digest(config)


def changes(config: CellConfig, found: CellCalibration, samples_digest: str) -> dict[str, Any]:
    """New values for ``update_cell_file``, the ``calibration`` section among them.

    Args:
        config: the cell as it was.
        found: the calibration.
        samples_digest: of the folder it was made from.
    """
    cameras = {name: _camera_fields(found.geometry.cameras[name]) for name in config.cameras}
    arms = {
        side: _base_fields(found.geometry.T_world_base[side])
        for side in config.arms
        if f"base/{side}" in found.adjustment.deviations
    }
    after = config.model_copy(
        update={
            "cameras": {
                name: camera.model_copy(update=cameras[name])
                for name, camera in config.cameras.items()
            },
            "arms": {
                side: arm.model_copy(update=arms.get(side, {})) for side, arm in config.arms.items()
            },
        }
    )
    residual = found.residuals["all"]
    section = {
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "hash": f"{numbers_digest(after)}:{samples_digest}",
        "residual_px": round(residual.px, 4),
        "residual_mm": round(residual.mm, 4),
        "residual_deg": round(residual.deg, 4),
        "verdict": found.verdict,
    }
    groups = {f"cameras.{name}": fields for name, fields in cameras.items()}
    groups |= {f"arms.{side}": fields for side, fields in arms.items()}
    groups["calibration"] = section
    return {
        f"{group}.{name}": value
        for group, fields in groups.items()
        for name, value in fields.items()
    }


def _camera_fields(camera: CameraModel) -> dict[str, list[float]]:
    K, T = camera.K, camera.T_world_camera
    return {
        "intrinsics_px": _listed(K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
        "distortion": _listed(*camera.distortion),
        "position_m": _listed(*T[:3, 3]),
        "rotation_rad": _listed(*log_so3(T[:3, :3])),
    }


def _base_fields(T_world_base: Array) -> dict[str, list[float]]:
    return {
        "base_position_m": _listed(*T_world_base[:3, 3]),
        "base_rotation_rad": _listed(*log_so3(T_world_base[:3, :3])),
    }


def _listed(*values: float) -> list[float]:
    return [float(value) + 0.0 for value in np.round(values, _DIGITS)]
