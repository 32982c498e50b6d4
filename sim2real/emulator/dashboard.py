"""Port 29999: the dashboard server, one reply per line.

Source: Universal Robots, "Dashboard Server e-Series"; wording as clients look for it.
"""

from collections.abc import Callable

from sim2real.emulator.connections import LineConnection, Listener
from sim2real.emulator.controller import Controller
from sim2real.emulator.modes import Runtime, Safety

DASHBOARD_PORT = 29999
_GREETING = b"Connected: Universal Robots Dashboard Server\n"
_LOCAL = "Command is not allowed due to safety reasons. Check if robot is in Remote Control"
_TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence."
    " Always inspect cause of protective stop before unlocking"
)


class DashboardServer:
    """The port people and clients operate the robot by."""

    def __init__(self, address: str, controller: Controller) -> None:
        self.dashboard = Dashboard(controller)
        self.listener = Listener(
            address, DASHBOARD_PORT, lambda port: _DashboardConnection(port, self.dashboard)
        )


class Dashboard:
    """The commands.

    Args:
        controller: that they act on.
    """

    def __init__(self, controller: Controller) -> None:
        self._robot = controller
        self._loaded = ""
        self._operational_mode = "NONE"
        version = ".".join(str(part) for part in controller.options.polyscope)
        self._questions: dict[str, Callable[[], str]] = {
            "polyscopeversion": lambda: f"URSoftware {version} (Mar 22 2022)",
            "version": lambda: version,
            "get serial number": lambda: controller.options.serial_number,
            "get robot model": lambda: "UR5",
            "is in remote control": lambda: _word(controller.remote),
            "robotmode": self._robot_mode,
            "safetymode": lambda: f"Safetymode: {controller.safety.name}",
            "safetystatus": lambda: f"Safetystatus: {controller.safety.name}",
            "running": lambda: f"Program running: {_word(controller.runtime is Runtime.PLAYING)}",
            "programstate": lambda: f"{controller.runtime.name} {self._program_name()}",
            "get loaded program": self._loaded_program,
            "isprogramsaved": lambda: f"true {self._program_name()}",
            "get operational mode": lambda: self._operational_mode,
            "close popup": self._close_popup,
            "close safety popup": lambda: "closing safety popup",
        }
        # These change something, so they need remote control.
        self._orders: dict[str, Callable[[], str]] = {
            "power on": lambda: self._power(release_brakes=False),
            "brake release": lambda: self._power(release_brakes=True),
            "power off": self._power_off,
            "shutdown": self._shut_down,
            "unlock protective stop": self._unlock,
            "restart safety": self._restart_safety,
            "play": self._play,
            "stop": self._stop,
            "pause": self._pause,
            "clear operational mode": lambda: self._set_operational_mode("NONE"),
        }
        # These have a text behind them.
        self._with_text: dict[str, Callable[[str], str]] = {
            "load": self._load,
            "popup": self._popup,
            "addtolog": self._add_to_log,
            "setuserrole": lambda role: f"Setting user role: {role}",
            "set operational mode": lambda mode: self._set_operational_mode(mode.upper()),
        }

    def reply(self, line: str) -> str:
        """What the server answers to a line."""
        command = " ".join(line.lower().split())
        if command in self._questions:
            return self._questions[command]()
        if command in self._orders:
            return self._orders[command]() if self._robot.remote else _LOCAL
        for name, action in self._with_text.items():
            if command == name or command.startswith(f"{name} "):
                return action(line.strip()[len(name) :].strip())
        return f'could not understand: "{line[:200]}"'

    def _robot_mode(self) -> str:
        return f"Robotmode: {self._robot.robot_mode.name}"

    def _program_name(self) -> str:
        program = self._robot.program
        return program.name if program is not None else self._loaded or "<unnamed>"

    def _loaded_program(self) -> str:
        if not self._loaded:
            return "No program loaded"
        return f"Loaded program: /programs/{self._loaded}"

    def _power(self, *, release_brakes: bool) -> str:
        if not self._robot.power_on(release_brakes=release_brakes):
            return "Power on failed: emergency stop"
        return "Brake releasing" if release_brakes else "Powering on"

    def _power_off(self) -> str:
        self._robot.power_off()
        return "Powering off"

    def _shut_down(self) -> str:
        self._robot.power_off()
        return "Shutting down"

    def _unlock(self) -> str:
        return "Protective stop releasing" if self._robot.unlock() else _TOO_EARLY

    def _restart_safety(self) -> str:
        if self._robot.safety is not Safety.ROBOT_EMERGENCY_STOP:
            self._robot.power_off()
            self._robot.safety, self._robot.stop_reason = Safety.NORMAL, ""
        return "Restarting safety"

    def _play(self) -> str:
        robot = self._robot
        if robot.resume_program():
            return "Starting program"
        if robot.runtime is Runtime.STOPPED and self._loaded and robot.ready:
            robot.start_program(_LoadedProgram(self._loaded))
            return "Starting program"
        return "Failed to execute: play"

    def _stop(self) -> str:
        # Also where nothing runs: ur_rtde's constructor ends a running program by its register and
        # then asks for this, and the emulator is quicker than a robot at the former.
        self._robot.stop_program("stopped by the dashboard")
        return "Stopped"

    def _pause(self) -> str:
        return "Pausing program" if self._robot.pause_program() else "Failed to execute: pause"

    def _load(self, name: str) -> str:
        if not self._robot.remote:
            return _LOCAL
        if not name.endswith(".urp"):
            return f"File not found: {name}"
        if self._robot.runtime is not Runtime.STOPPED:
            self._robot.stop_program("another program is loaded")
        self._loaded = name
        return f"Loading program: /programs/{name}"

    def _popup(self, text: str) -> str:
        self._robot.popups.append(text[:500])
        return "showing popup"

    def _close_popup(self) -> str:
        if self._robot.popups:
            self._robot.popups.pop()
        return "closing popup"

    def _add_to_log(self, text: str) -> str:
        self._robot.note(text[:500])
        return "Added log message"

    def _set_operational_mode(self, mode: str) -> str:
        if mode not in ("NONE", "MANUAL", "AUTOMATIC"):
            return "Failed setting operational mode"
        self._operational_mode = mode
        if mode == "NONE":
            return "No longer controlling the operational mode"
        return f"Setting operational mode: {mode}"


class _LoadedProgram:
    """A program from the robot's disk; the emulator does not know what it does."""

    def __init__(self, name: str) -> None:
        self.name = name

    def step(self) -> bool:
        return True


class _DashboardConnection(LineConnection):
    def __init__(self, listener: Listener, dashboard: Dashboard) -> None:
        super().__init__(listener)
        self._dashboard = dashboard

    def greet(self) -> None:
        self.send(_GREETING)

    def answer(self, line: str) -> str | None:
        if line.lower() == "quit":
            self.send(b"Disconnected\n")
            self.close()
            return None
        return self._dashboard.reply(line) if line else None


def _word(value: bool) -> str:
    return "true" if value else "false"
