"""From settings to a camera of its driver."""

from dlo_gym.geometry.camera import CameraModel
from sim2real.cameras.camera import Camera, CameraSettings


def make_camera(settings: CameraSettings, model: CameraModel) -> Camera:
    """The camera that the settings describe, not yet open.

    Raises:
        MissingExtra: if the driver's package is not installed.
        ValueError: if the device does not fit the driver.
    """
    # Each driver is imported with its first camera: depthai alone takes a second.
    if settings.driver == "mjpeg":
        from sim2real.cameras.mjpeg_camera import MjpegCamera

        return MjpegCamera(settings, model)
    if settings.driver == "oak":
        from sim2real.cameras.oak_camera import OakCamera

        return OakCamera(settings, model)
    from sim2real.cameras.opencv_camera import OpenCVCamera

    return OpenCVCamera(settings, model)
