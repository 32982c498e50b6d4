"""Rotations, rigid transforms, cameras and curves."""

from dlo_gym.geometry.camera import CameraModel, View

__all__ = ["CameraModel", "View"]
