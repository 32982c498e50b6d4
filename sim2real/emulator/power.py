"""The arm's power: off, on, idle, running with free brakes, with the time that each step takes."""

from sim2real.emulator.modes import RobotMode


class Power:
    """A robot that runs at the start.

    Args:
        delay: how long power on and brake release take [s] each.

    Attributes:
        mode: at present.
    """

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self.mode = RobotMode.RUNNING
        self._goal = RobotMode.RUNNING
        self._change: tuple[float, RobotMode] | None = None  # monotonic [s], to which mode

    @property
    def running(self) -> bool:
        return self.mode is RobotMode.RUNNING

    def on(self, now: float, *, release_brakes: bool) -> None:
        """Power the arm up from ``now`` (monotonic [s]), to idle or with free brakes."""
        goal = RobotMode.RUNNING if release_brakes else RobotMode.IDLE
        if self.mode >= goal:
            return
        self._goal = goal
        if self.mode is RobotMode.POWER_OFF:
            self.mode = RobotMode.POWER_ON
            self._change = now + self.delay, RobotMode.IDLE
        elif self.mode is RobotMode.IDLE:
            self._change = now + self.delay, RobotMode.RUNNING

    def off(self) -> None:
        self.mode, self._change = RobotMode.POWER_OFF, None

    def tick(self, now: float) -> None:
        """Take the change that is due at ``now`` (monotonic [s])."""
        if self._change is None or now < self._change[0]:
            return
        self.mode, self._change = self._change[1], None
        if self.mode is RobotMode.IDLE and self._goal is RobotMode.RUNNING:
            self._change = now + self.delay, RobotMode.RUNNING
