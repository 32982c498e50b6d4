"""What a rod is made of."""

from dataclasses import dataclass
from math import isfinite, pi

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array

# Shear correction factor of a solid circular section (Cowper 1966, nu = 0.5; PyElastica's value).
SHEAR_CORRECTION = 27.0 / 28.0
PER_ELEMENT = (
    "radius", "youngs_modulus", "density", "EI", "GJ", "EA", "kGA", "mass_per_length",
    "yield_curvature",
)  # fmt: skip


@dataclass(frozen=True)
class RodProperties:
    """A rod of solid circular cross-section, or one whose stiffnesses are known by themselves.

    Scalars describe a uniform rod; fields of type ``float | Array`` also take one value per
    element, shape (n_elements,).

    Attributes:
        length: rest length [m].
        radius: of the cross-section [m].
        youngs_modulus: E [Pa].
        density: [kg/m^3].
        poisson_ratio: nu; the shear modulus is G = E / (2 (1 + nu)).
        rest_curvature: (3,) or (n_elements - 1, 3) curvature and twist of the unloaded rod in
            its material frame [1/m]: about d1, about d2, and twist about d3.
        EI, GJ, EA, kGA: stiffness to bending, twist [N m^2], stretch and shear [N]; each replaces
            the one that follows from E, nu and the radius.
        mass_per_length: [kg/m]; replaces the one that follows from density and radius.
        external_damping: rate at which the surroundings slow every part of the rod [1/s].
        internal_damping: viscosity over stiffness, eta of S (strain + eta d(strain)/dt) [s].
        yield_curvature: elastic curvature beyond which the rod bends for good [1/m]; None if never.
        hardening: slope of the moment beyond yield over EI, from 0 up to less than 1.
        creep: share of EI and GJ that relaxes with time (a standard linear solid), 0 to 1.
        relaxation_time: time constant of that share under constant curvature [s].

    Raises:
        ValueError: naming the field, if a value is not finite or not physical.
    """

    length: float
    radius: float | Array = 0.003
    youngs_modulus: float | Array = 1e6
    density: float | Array = 1e3
    poisson_ratio: float = 0.5
    rest_curvature: Array | tuple[float, float, float] = (0.0, 0.0, 0.0)
    EI: float | Array | None = None
    GJ: float | Array | None = None
    EA: float | Array | None = None
    kGA: float | Array | None = None
    mass_per_length: float | Array | None = None
    external_damping: float = 0.0
    internal_damping: float = 0.0
    yield_curvature: float | Array | None = None
    hardening: float = 0.0
    creep: float = 0.0
    relaxation_time: float = 1.0

    def __post_init__(self) -> None:
        for name in ("length", "relaxation_time"):
            value = getattr(self, name)
            if not (_is_number(value) and value > 0.0):
                unit = "length [m]" if name == "length" else "time [s]"
                raise ValueError(f"{name}: expected a positive {unit}, got {value!r}")
        for name in PER_ELEMENT:
            if getattr(self, name) is None:
                continue
            values = _numbers(getattr(self, name))
            if values.ndim > 1 or not np.isfinite(values).all() or not (values > 0).all():
                raise ValueError(
                    f"{name}: expected a positive number or one per element,"
                    f" got {getattr(self, name)!r}"
                )
            object.__setattr__(self, name, values if values.ndim else float(values))
        if not (_is_number(self.poisson_ratio) and -1.0 < self.poisson_ratio <= 0.5):
            raise ValueError(f"poisson_ratio: expected -1 < nu <= 0.5, got {self.poisson_ratio!r}")
        for name in ("external_damping", "internal_damping"):
            value = getattr(self, name)
            if not (_is_number(value) and value >= 0.0):
                raise ValueError(f"{name}: expected zero or a positive number, got {value!r}")
        for name in ("hardening", "creep"):
            value = getattr(self, name)
            if not (_is_number(value) and 0.0 <= value < 1.0):
                raise ValueError(f"{name}: expected 0 <= {name} < 1, got {value!r}")
        if self.hardening > 0.0 and self.yield_curvature is None:
            raise ValueError(
                "hardening: expected with a yield_curvature only, beyond which it acts,"
                f" got {self.hardening} and None"
            )
        rest = _numbers(self.rest_curvature)
        if rest.shape[-1:] != (3,) or rest.ndim > 2 or not np.isfinite(rest).all():
            raise ValueError(
                "rest_curvature: expected finite values of shape (3,) or (n_elements - 1, 3),"
                f" got shape {rest.shape}"
            )

    def check_n_elements(self, n_elements: int) -> None:
        """Check that a rod of ``n_elements`` can have these properties.

        Raises:
            ValueError: naming the property that has another number of values, or the radius if
                elements are shorter than it: such a rod has no cross-section to speak of.
        """
        for name in PER_ELEMENT:
            shape = np.shape(getattr(self, name))
            if shape not in ((), (n_elements,)):
                raise ValueError(
                    f"{name}: expected one value per element, {n_elements}, got {shape[0]}"
                )
        rest = np.shape(self.rest_curvature)
        if len(rest) == 2 and rest[0] != n_elements - 1:
            raise ValueError(f"rest_curvature: expected {n_elements - 1} rows, got {rest[0]}")
        if not np.max(self.radius) <= self.length / n_elements:
            raise ValueError(
                f"radius: expected at most an element's length, {self.length / n_elements:.4g} m,"
                f" got {np.max(self.radius):.4g} m; take fewer elements"
            )

    @property
    def area(self) -> float | Array:
        """A [m^2]."""
        return pi * np.square(self.radius)

    @property
    def shear_modulus(self) -> float | Array:
        """G [Pa]."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def bending_stiffness(self) -> float | Array:
        """EI [N m^2]."""
        if self.EI is not None:
            return self.EI
        return self.youngs_modulus * np.square(self.area) / (4.0 * pi)

    @property
    def twisting_stiffness(self) -> float | Array:
        """GJ [N m^2]."""
        if self.GJ is not None:
            return self.GJ
        return self.shear_modulus * np.square(self.area) / (2.0 * pi)

    @property
    def stretching_stiffness(self) -> float | Array:
        """EA [N]."""
        if self.EA is not None:
            return self.EA
        return self.youngs_modulus * self.area

    @property
    def shearing_stiffness(self) -> float | Array:
        """kGA [N], k the shear correction factor."""
        if self.kGA is not None:
            return self.kGA
        return SHEAR_CORRECTION * self.shear_modulus * self.area

    @property
    def linear_density(self) -> float | Array:
        """Mass per length [kg/m]."""
        if self.mass_per_length is not None:
            return self.mass_per_length
        return self.density * self.area


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and isfinite(value)


def _numbers(values: object) -> Array:
    """As an array, of NaN where they are no numbers."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.array(np.nan)


def per_element(values: ArrayLike, n_elements: int) -> Array:
    """A scalar or (n_elements,) property as an array (n_elements,)."""
    return np.ascontiguousarray(np.broadcast_to(values, n_elements), dtype=np.float64)
