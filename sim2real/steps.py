"""The closed loop at its clock: samples in, commands out, one period after another."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from control.monitor import ArmReading
from dlo_gym.exceptions import DeviceError, SafetyStop
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryPoses
from sim2real.cell import CellSample, RobotCell
from sim2real.loop import ClosedLoop, LoopInput, LoopOutput

# The share of a period by which a target lies beyond the next command: without it the arms would
# slow down at each target.
BLEND = 1.5
PASSING = ("pose age", "image age", "program")
RECOVERY_PAUSE = 0.5  # between two attempts [s]


@dataclass(frozen=True, eq=False)
class CellStep:
    """One control step on a cell.

    Attributes:
        given: what the step was computed from.
        output: what it came to.
        accepted: the clamp poses that the arms accepted; None in a dry run.
        readings: of both arms when the command went out.
        taken: time of the images, monotonic [s].
        sent: when that was, since the start of the run [s].
        late: how long after the end of its period that was; 0 if in time [s].
        begins: whether controller and gate began anew with it: the first that is sent, at the start
            and after a stop.
    """

    given: LoopInput
    output: LoopOutput
    accepted: BoundaryPoses | None
    readings: dict[str, ArmReading]
    taken: float
    sent: float
    late: float
    begins: bool

    @property
    def wrenches(self) -> Array:
        """(2, 6) that the arms feel, base axes [N], [N m]."""
        return np.stack([reading.wrench for reading in self.readings.values()])


def control_steps(
    cell: RobotCell,
    loop: ClosedLoop,
    *,
    steps: int,
    dry_run: bool = False,
    recoveries: int = 0,
) -> Iterator[CellStep]:
    """Runs ``loop`` on an open cell, yielding every step when its command is out.

    The first step only looks: it finds the cable, which takes longer than a period, before control
    is taken of the arms.

    Args:
        cell: open; control is taken when everything is ready, in a dry run never.
        loop: the controller's side.
        steps: how many at most, beside the first.
        dry_run: computes everything and sends nothing.
        recoveries: how many stops the loop gets over by itself, from the poses the arms then have.

    Raises:
        SafetyStop, DeviceError, TrackLost, SolverFailed: after both arms were told to stop.
    """
    period, origin = cell.config.control.period_s, None
    tick, begins, made = 0.0, False, 0
    while made < steps:
        try:
            if origin is None:
                first = cell.refresh()
                _warm_up(cell, loop, first)
                step = _step(cell, loop, first, first.stamp)
                origin = first.stamp
                yield replace(step, begins=begins)
                tick, begins = time.monotonic(), False
            if not dry_run and not cell.under_control:
                cell.engage()
                loop.resume(cell.commanded)
                cell.refresh()
                tick, begins = time.monotonic(), True
            step = _step(cell, loop, cell.wait_for_sample(), origin, None if dry_run else period)
            late = max(0.0, step.sent + origin - (tick + period))
            yield replace(step, late=late, begins=begins)
            begins, made = False, made + 1
            # After a late step the next one starts at once, and the periods count from there.
            tick = max(tick + period, time.monotonic())
            cell.wait_until(tick)
        except (SafetyStop, DeviceError) as stop:
            cell.halt()
            if recoveries <= 0 or not cell.under_control or not _is_passing(stop):
                raise
            recoveries -= 1
            _recover(cell, loop, 10.0)
            tick, begins = time.monotonic(), True
        except BaseException:
            cell.halt()
            raise


def _step(
    cell: RobotCell,
    loop: ClosedLoop,
    sample: CellSample,
    origin: float,
    period: float | None = None,
) -> CellStep:
    """Looks, computes and, with a ``period`` [s], sends."""
    given = _input(cell, sample, cell.commanded, origin)
    output = loop.step(given)
    accepted = None
    if period is None:
        loop.gate.reset()  # nothing was sent
    else:
        accepted = cell.send(output.decision.target, BLEND * period)
    sent = time.monotonic() - origin
    return CellStep(given, output, accepted, cell.readings(), sample.stamp, sent, 0.0, False)


def _input(
    cell: RobotCell, sample: CellSample, commanded: BoundaryPoses, origin: float
) -> LoopInput:
    views = tuple(replace(view, stamp=view.stamp - origin) for view in sample.views)
    return LoopInput(views, sample.stamp - origin, sample.boundary, commanded, cell.joint_angles)


def _warm_up(cell: RobotCell, loop: ClosedLoop, sample: CellSample) -> None:
    """One step of a loop that is thrown away: compiles and loads before the clock runs."""
    given = _input(cell, sample, cell.commanded, sample.stamp)
    ClosedLoop(loop.config, loop.goal).step(given)


def _is_passing(stop: SafetyStop | DeviceError) -> bool:
    """Whether what stopped the arms may be over without a person: a link, not a force."""
    return isinstance(stop, DeviceError) or stop.limit in PASSING


def _recover(cell: RobotCell, loop: ClosedLoop, timeout: float) -> None:
    """Tries to make cell and loop ready again until ``timeout`` [s] has passed."""
    deadline = time.monotonic() + timeout
    while True:
        try:
            cell.recover()
            cell.refresh()
            loop.resume(cell.commanded)
            return
        except DeviceError:
            cell.halt()
            if time.monotonic() > deadline:
                raise
            time.sleep(RECOVERY_PAUSE)
