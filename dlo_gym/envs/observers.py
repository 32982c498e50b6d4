"""How an environment comes to know the rod's shape."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, Protocol

import numpy as np

from dlo_gym.envs.cell import SimulatedCell
from dlo_gym.rod.boundary import BoundaryDisplacement
from dlo_gym.rod.state import ShapeEstimate


class Observer(Protocol):
    """Estimates the rod's shape from what a cell lets it see."""

    def reset(self, cell: SimulatedCell) -> ShapeEstimate:
        """The shape at the start of an episode."""
        ...

    def update(self, cell: SimulatedCell, displacement: BoundaryDisplacement) -> ShapeEstimate:
        """The shape after the clamps have moved by ``displacement``.

        Raises:
            TrackLost: if the observer has not seen the rod for too long.
        """
        ...

    def close(self) -> None: ...


class PrivilegedObserver:
    """Reads the simulator's own state."""

    def reset(self, cell: SimulatedCell) -> ShapeEstimate:
        positions = cell.rod_state.positions
        return ShapeEstimate(
            centerline=positions.copy(),
            visible=np.zeros((0, len(positions)), dtype=bool),
            confidence=np.ones(len(positions)),
            stamp=cell.stamp,
        )

    def update(self, cell: SimulatedCell, displacement: BoundaryDisplacement) -> ShapeEstimate:
        return self.reset(cell)

    def close(self) -> None:
        pass


def make_observer(name: str, options: Mapping[str, Any]) -> Observer:
    """The observer called ``"privileged"`` or ``"module:Class"``, given ``options``.

    Raises:
        ValueError: if there is no such class, or it does not take these options.
    """
    if name == "privileged":
        observer: Any = PrivilegedObserver
    else:
        module, attribute = name.split(":")
        try:
            observer = getattr(import_module(module), attribute)
        except (ModuleNotFoundError, AttributeError) as error:
            raise ValueError(f"observer: cannot load {name!r}: {error}") from error
    try:
        return observer(**options)
    except TypeError as error:
        raise ValueError(
            f"observer_options: {name!r} does not take {', '.join(options)}: {error}"
        ) from error
