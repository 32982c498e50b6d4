"""From the controller's clock to this machine's."""

from collections import deque
from math import inf


class RobotClock:
    """Stamps free of transport jitter.

    A reading arrives at ``robot_time + offset + delay``, where the delay is never negative and now
    and then nearly nothing. So the smallest ``arrival - robot_time`` seen is the offset, up to the
    shortest delay, and ``robot_time + offset`` is as even as the robot's clock. The two clocks
    drift apart by up to some 50 millionths, so the minimum is taken over the last ``window``
    seconds only (by whole seconds: 0.5 ms of drift in 10 s). Stamps never run backwards.

    Args:
        window: in which the smallest delay is sought [s].
    """

    def __init__(self, window: float = 10.0) -> None:
        self._buckets: deque[float] = deque(maxlen=max(1, round(window)))
        self._second = -inf
        self._last_robot_time = -inf
        self._last_stamp = -inf

    def stamp(self, robot_time: float, arrival: float) -> float:
        """When, on the monotonic clock [s], the reading of ``robot_time`` [s] was so."""
        if robot_time < self._last_robot_time:  # the controller was restarted
            self._buckets.clear()
        self._last_robot_time = robot_time
        offset = arrival - robot_time
        if not self._buckets or arrival - self._second >= 1.0:
            self._second = arrival
            self._buckets.append(offset)
        elif offset < self._buckets[-1]:
            self._buckets[-1] = offset
        stamp = robot_time + min(self._buckets)
        self._last_stamp = stamp = max(stamp, self._last_stamp + 1e-6)
        return stamp
