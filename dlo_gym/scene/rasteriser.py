"""A canvas without OpenGL: the cell's primitives drawn by rays through the pixels."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.scene._kernels_raster import Lights, Pinhole, draw, paint_texture
from dlo_gym.scene._kernels_rays import PLANE
from dlo_gym.scene.primitives import ModelPrimitives


class Layer(NamedTuple):
    """Colours (height, width, 3) and nearness (height, width), which is 1 / depth [1/m]."""

    rgb: NDArray[np.uint8]
    nearness: NDArray[np.float32]


class RasterCanvas:
    """Draws one model's geoms as its OpenGL canvas does, a little simpler and much faster.

    The scenery, which never moves, is drawn once per camera.

    Args:
        model: the compiled scene.
        scenery: ids of the geoms that never move.
    """

    def __init__(self, model: mujoco.MjModel, scenery: NDArray[np.intp]) -> None:
        self._model = model
        self._fixed = scenery
        self._moving = np.setdiff1d(np.arange(model.ngeom), scenery)
        self._primitives = ModelPrimitives(model)
        self._optics: dict[str, tuple[Pinhole, Lights]] = {}
        self._scenery: dict[str, Layer] = {}
        self._nearness: dict[str, NDArray[np.float32]] = {}

    def color(self, data: mujoco.MjData, name: str, pinhole: CameraModel) -> NDArray[np.uint8]:
        """RGB (height, width, 3) of the model's camera ``name``."""
        return self.layer(data, name, pinhole).rgb

    def layer(self, data: mujoco.MjData, name: str, pinhole: CameraModel) -> Layer:
        """Colours and depth of the model's camera ``name``, the latter until the next call."""
        layer = self._copy_of_scenery(data, name, pinhole)
        self._draw(layer, data, pinhole, self._moving)
        return layer

    def mask(
        self, data: mujoco.MjData, name: str, pinhole: CameraModel, geom_ids: NDArray[np.intp]
    ) -> NDArray[np.uint8]:
        """1 where a pixel (height, width) of camera ``name`` shows one of the geoms, else 0."""
        layer = self._copy_of_scenery(data, name, pinhole)
        self._draw(layer, data, pinhole, np.setdiff1d(self._moving, geom_ids))
        without = layer.nearness.copy()
        self._draw(layer, data, pinhole, geom_ids)
        return (layer.nearness > without).astype(np.uint8)

    def forget_scenery(self) -> None:
        """Draw the scenery anew at the next look, for what stands in it has changed."""
        self._scenery.clear()

    def close(self) -> None:
        pass

    def _copy_of_scenery(self, data: mujoco.MjData, name: str, pinhole: CameraModel) -> Layer:
        if name not in self._scenery:
            shape = (pinhole.height, pinhole.width)
            scenery = Layer(np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32))
            self._draw_scenery(scenery, data, pinhole)
            self._scenery[name] = scenery
            self._nearness[name] = np.empty(shape, np.float32)
        scenery = self._scenery[name]
        np.copyto(self._nearness[name], scenery.nearness)
        return Layer(scenery.rgb.copy(), self._nearness[name])

    def _draw_scenery(self, layer: Layer, data: mujoco.MjData, pinhole: CameraModel) -> None:
        model = self._model
        is_plane = model.geom_type[self._fixed] == PLANE
        self._draw(layer, data, pinhole, self._fixed[~is_plane])
        for geom in self._fixed[is_plane]:
            before = layer.nearness.copy()
            self._draw(layer, data, pinhole, self._fixed[self._fixed == geom])
            material = model.geom_matid[geom]
            texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
            if material >= 0 and texture >= 0:
                paint_texture(
                    layer.rgb,
                    layer.nearness,
                    before,
                    _pinhole(pinhole),
                    model.geom_size[geom],
                    data.geom_xpos[geom],
                    data.geom_xmat[geom].reshape(3, 3),
                    _texels(model, texture),
                    model.mat_texrepeat[material].astype(np.float64),
                )

    def _draw(
        self,
        layer: Layer,
        data: mujoco.MjData,
        pinhole: CameraModel,
        geom_ids: NDArray[np.intp],
    ) -> None:
        """Draws over ``layer`` those of the geoms that are not hidden."""
        # The nearest first, so that little is painted over.
        away = np.square(data.geom_xpos[geom_ids] - pinhole.centre).sum(axis=1)
        nearest_first = geom_ids[np.argsort(away, kind="stable")]
        if pinhole.name not in self._optics:
            self._optics[pinhole.name] = _pinhole(pinhole), _lights(self._model, data, pinhole)
        optics, lights = self._optics[pinhole.name]
        primitives = self._primitives.posed(data, nearest_first)
        draw(layer.rgb, layer.nearness, optics, primitives, lights)


def _pinhole(camera: CameraModel) -> Pinhole:
    rotation = np.ascontiguousarray(camera.T_world_camera[:3, :3])
    return Pinhole(camera.K, rotation, np.ascontiguousarray(camera.centre))


def _lights(model: mujoco.MjModel, data: mujoco.MjData, pinhole: CameraModel) -> Lights:
    """The model's directional lights and the one that goes with the camera."""
    headlight = model.vis.headlight
    forward = pinhole.T_world_camera[:3, 2]
    towards = -np.vstack([data.light_xdir, forward])
    halfway = towards - forward
    halfway /= np.maximum(np.linalg.norm(halfway, axis=1, keepdims=True), 1e-12)
    return Lights(
        towards,
        halfway,
        np.vstack([model.light_diffuse, headlight.diffuse]).astype(np.float64),
        np.vstack([model.light_specular, headlight.specular]).astype(np.float64),
        headlight.ambient + model.light_ambient.sum(axis=0).astype(np.float64),
    )


def _texels(model: mujoco.MjModel, texture: int) -> NDArray[np.uint8]:
    """(height, width, 3) RGB of a texture."""
    height, width = model.tex_height[texture], model.tex_width[texture]
    start = model.tex_adr[texture]
    return model.tex_data[start : start + 3 * height * width].reshape(height, width, 3)
