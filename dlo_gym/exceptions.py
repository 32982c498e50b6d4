"""The errors a caller of this project may want to catch."""

from typing import Any


class DloError(Exception):
    """Base of every error this project raises on purpose, apart from ``ValueError``."""


class RodDiverged(DloError):
    """The rod solver found no trustworthy equilibrium.

    Attributes:
        last_good: the ``RodState`` before the request, to which the rod has been restored; None
            only where it had none, because it had never settled.
    """

    def __init__(self, message: str, last_good: Any = None) -> None:
        super().__init__(message)
        self.last_good = last_good


class UnreachablePose(DloError):
    """A TCP pose outside an arm's workspace or joint limits."""


class RenderingUnavailable(DloError):
    """No headless OpenGL context, or no display for a viewer, is to be had on this machine."""


class RecordingError(DloError):
    """A recording on disk is incomplete, malformed or inconsistent; names the file."""


class WeightsError(DloError):
    """A file of trained weights is missing, damaged or of another version; names the file."""


class DatasetError(DloError):
    """A dataset folder or one of its shards is incomplete or damaged; names the file."""


class WorkersLost(DloError):
    """Processes that worked at a task died again and again."""


class TrackLost(DloError):
    """The tracker has not seen the rod for longer than it was allowed to."""


class SolverFailed(DloError):
    """The optimisation behind a controller gave no usable answer."""


class IdentificationFailed(DloError):
    """No rod of plausible parameters could follow how a cable moved."""


class DeviceError(DloError):
    """An arm, gripper or camera cannot be reached, went silent, or refused what it was asked."""


class SafetyStop(DloError):
    """A limit was violated and the arms must hold still.

    Attributes:
        limit: name of the limit; empty where none has a number.
        value: what was measured or asked for, in the unit of ``bound``.
        bound: of the limit.
    """

    def __init__(
        self,
        message: str,
        *,
        limit: str = "",
        value: float = float("nan"),
        bound: float = float("nan"),
    ) -> None:
        super().__init__(message)
        self.limit = limit
        self.value = value
        self.bound = bound


class MissingExtra(DloError, ImportError):
    """An optional dependency is not installed; says which pip command adds it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(
            f"{package} is not installed; add it with:  pip install 'dlo-gym[{extra}]'"
        )
