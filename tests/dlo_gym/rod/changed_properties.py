"""A rod's properties with one parameter of a sensitivity changed."""

from dataclasses import replace

import numpy as np

from dlo_gym.rod import RodProperties

REST = ("rest_curvature_1", "rest_curvature_2", "rest_twist")


def changed(p: RodProperties, name: str, step: float) -> RodProperties:
    """Logarithms grow by ``step``, the rest in its own unit."""
    if name == "log_EI":
        return replace(p, EI=p.bending_stiffness * np.exp(step))
    if name == "log_GJ":
        return replace(p, GJ=p.twisting_stiffness * np.exp(step))
    if name == "log_weight":
        return replace(p, mass_per_length=p.linear_density * np.exp(step))
    if name in REST:
        return replace(p, rest_curvature=p.rest_curvature + step * np.eye(3)[REST.index(name)])
    return replace(p, **{name: getattr(p, name) + step})
