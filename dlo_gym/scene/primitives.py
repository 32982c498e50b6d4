"""A compiled model's geoms as arrays, for rays."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array
from dlo_gym.scene._kernels_rays import BOX, Primitives

_UNPAINTED = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that has none of its own
_REFLECTANCE = (0.5, 0.5)  # MuJoCo's specular and shininess without a material
_EXPONENT = 128.0  # of shininess 1


class ModelPrimitives:
    """The geoms of one model.

    A mesh stands as its bounding box: the only ones in the cell are the flat plates of boards.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._meshes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
        self._paints = _paints(model)
        # Their colour may change: it is looked up whenever they are posed.
        self._by_material = np.flatnonzero(
            [
                material >= 0 and np.allclose(own[:3], _UNPAINTED[:3])
                for own, material in zip(model.geom_rgba, model.geom_matid, strict=True)
            ]
        )

    def posed(
        self, data: mujoco.MjData, geom_ids: NDArray[np.intp] | slice = slice(None)
    ) -> Primitives:
        """Those of the geoms that are not hidden, where ``data`` has them."""
        kinds, sizes = self._model.geom_type.copy(), self._model.geom_size.copy()
        kinds[self._meshes] = BOX
        sizes[self._meshes] = self._model.geom_aabb[self._meshes, 3:]
        ids = np.arange(self._model.ngeom)[geom_ids]
        ids = ids[self._model.geom_rgba[ids, 3] > 0.0]
        materials = self._model.geom_matid[self._by_material]
        self._paints[self._by_material, :3] = self._model.mat_rgba[materials, :3]
        return Primitives(
            kinds[ids],
            sizes[ids],
            data.geom_xpos[ids],
            data.geom_xmat[ids].reshape(-1, 3, 3),
            self._paints[ids],
        )


def _paints(model: mujoco.MjModel) -> Array:
    """(n_geoms, 5) RGB, specular reflectance and log2 of its exponent, of every geom."""
    paints = np.empty((model.ngeom, 5))
    for geom, material in enumerate(model.geom_matid):
        own = model.geom_rgba[geom]
        plain = material < 0 or not np.allclose(own, _UNPAINTED)
        paints[geom, :3] = own[:3] if plain else model.mat_rgba[material, :3]
        paints[geom, 3:] = _REFLECTANCE
        if material >= 0:
            paints[geom, 3:] = model.mat_specular[material], model.mat_shininess[material]
    # Rounded to a power of two, which takes a few squarings.
    paints[:, 4] = np.round(np.log2(_EXPONENT * np.maximum(paints[:, 4], 1.0 / _EXPONENT)))
    return paints
