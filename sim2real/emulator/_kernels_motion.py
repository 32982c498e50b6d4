"""One tick of the emulated joints, compiled."""

import numpy as np
from numba import njit

from sim2real.emulator import kinematics
from sim2real.emulator.kinematics import Array

TICK = 0.002  # s, the controller's cycle: 500 Hz


@njit(cache=True)
def largest_gap(first: Array, second: Array) -> float:
    """The largest |first - second| of (6,); NaN if one is NaN."""
    largest = 0.0
    for i in range(6):
        gap = abs(first[i] - second[i])
        if not gap <= largest:
            largest = gap
        if np.isnan(gap):
            return gap
    return largest


@njit(cache=True)
def servo(
    q: Array,
    qd: Array,
    qdd: Array,
    target: Array,
    lag: float,
    most_speed: float,
    most_acceleration: float,
) -> None:
    """Update q, qd, qdd (6,) by one tick of a first-order lag within speed and acceleration limits.

    The speed also stays below what 0.8 of the acceleration can brake in the way that is left.
    """
    change = most_acceleration * TICK
    for i in range(6):
        error = target[i] - q[i]
        away = abs(error)
        speed = min(away / lag, np.sqrt(1.6 * most_acceleration * away), most_speed)
        wanted = speed if error > 0.0 else -speed
        before = qd[i]
        qd[i] = min(max(wanted, before - change), before + change)
        if away < 1e-10 and abs(qd[i]) < 1e-8:
            qd[i] = 0.0
            q[i] = target[i]
        q[i] += qd[i] * TICK
        qdd[i] = (qd[i] - before) / TICK


@njit(cache=True)
def ramp(q: Array, qd: Array, wanted: Array, acceleration: float) -> None:
    """Update q, qd (6,) by one tick towards ``wanted``, the leading joint at the limit."""
    largest = 0.0
    for i in range(6):
        largest = max(largest, abs(wanted[i] - qd[i]))
    share = min(1.0, acceleration * TICK / largest) if largest > 0.0 else 1.0
    for i in range(6):
        qd[i] += share * (wanted[i] - qd[i])
        q[i] += qd[i] * TICK


@njit(cache=True)
def joint_velocity(q: Array, qd: Array, tool: Array, velocity: Array, out: Array) -> float:
    """Update joint velocities ``out`` (6,) of a TCP velocity (6,) half a tick ahead; |det J|."""
    T, J, ahead = np.empty((4, 4)), np.empty((6, 6)), np.empty(6)
    for i in range(6):
        ahead[i] = q[i] + 0.5 * TICK * qd[i]
        out[i] = velocity[i]
    kinematics.forward_and_jacobian(ahead, tool, T, J)
    return kinematics.solve6(J, out)
