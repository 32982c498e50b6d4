"""The emulated closed loop for a long time: memory, deadlines, commands, reconnections.

``make soak`` runs 30 minutes; a test runs a minute of it.
"""

import itertools
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import psutil
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dlo_gym.exceptions import DeviceError, SafetyStop
from dlo_gym.scene.arms import SIDES
from sim2real.cell import RobotCell
from sim2real.config import TEMPLATES, CellConfig
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.goals import make_goal
from sim2real.loop import ClosedLoop
from sim2real.steps import control_steps

EPISODE = 60  # control steps to one goal
SETTLED = 1.0  # after the last command of an episode [s]
RECOVERIES = 10  # of one episode, by the loop itself
WARM = 0.3  # share of the run after which memory counts


@dataclass
class Soak:
    """What a long run came to.

    Attributes:
        steps: commands sent and accepted.
        late: of each step [s].
        arrived: after each episode, how far a clamp is from where it was last sent [m].
        restarts: how often the loop began anew after a link had broken, by itself.
        memory: per process, resident bytes over time.
    """

    steps: int = 0
    late: list[float] = field(default_factory=list)
    arrived: list[float] = field(default_factory=list)
    restarts: int = 0
    memory: dict[str, list[int]] = field(default_factory=dict)

    def note_memory(self, processes: dict[str, int]) -> None:
        """Appends the resident memory of processes (ids by name)."""
        for name, pid in processes.items():
            self.memory.setdefault(name, []).append(psutil.Process(pid).memory_info().rss)

    def growth(self, process: str) -> float:
        """Largest memory after the warm-up relative to that at its end [-]."""
        values = self.memory[process][int(WARM * len(self.memory[process])) :]
        return max(values) / values[0] - 1.0


def soak(config: CellConfig, minutes: float) -> Iterator[Soak]:
    """Steers the cable of the emulated cell from goal to goal, yielding after every step."""
    result = Soak()
    end = time.monotonic() + 60.0 * minutes
    with EmulatedCell.of(config) as emulation, RobotCell(config) as robot:
        robot.open()
        robot.engage()
        home, home_shape = robot.commanded, emulation.truth().centerline
        for goal_seed in itertools.count():
            if time.monotonic() >= end:
                return
            _make_ready(robot, result)
            # To a goal and home again, else the arms would wander off.
            away = goal_seed % 2 == 0
            goal = make_goal("sampled", config, home, goal_seed) if away else home_shape
            loop = ClosedLoop(config, goal)
            for step in control_steps(robot, loop, steps=EPISODE, recoveries=RECOVERIES):
                result.steps += 1
                result.late.append(step.late)
                result.restarts += step.begins
                if result.steps % 10 == 0:
                    result.note_memory(_processes(emulation, robot))
                yield result
            _see_arrive(robot, result)


def _processes(emulation: EmulatedCell, robot: RobotCell) -> dict[str, int]:
    """Ids of all processes of the emulated cell and of its user, by name."""
    clients = {f"{side} client": robot.arms[side].client_pid for side in SIDES}  # type: ignore[attr-defined]
    return emulation.pids | {"loop": os.getpid()} | clients


def _make_ready(robot: RobotCell, result: Soak) -> None:
    """Gets over a link that broke between two episodes, as the loop does within one."""
    try:
        robot.readings()
    except DeviceError:
        robot.recover()
        result.restarts += 1


def _see_arrive(robot: RobotCell, result: Soak) -> None:
    """Waits until the arms are where they were sent, and notes how far off they are."""
    commanded = robot.commanded
    with suppress(DeviceError, SafetyStop):  # a link broke, which the next episode sees to
        robot.wait_until(time.monotonic() + SETTLED)
        away = robot.boundary.displacement_to(commanded).vector.reshape(2, 2, 3)
        result.arrived.append(float(np.linalg.norm(away[:, 0], axis=1).max()))


def main(minutes: float = 30.0) -> None:
    """Run the emulated closed loop for a long time and report.

    Args:
        minutes: how long.
    """
    config = CellConfig.load(TEMPLATES / "emulated.toml")
    result = Soak()
    with Progress(transient=True) as progress:
        task = progress.add_task("soaking", total=minutes)
        started = time.monotonic()
        for result in soak(config, minutes):  # noqa: B007
            progress.update(task, completed=(time.monotonic() - started) / 60.0)
    table = Table("measure", "value", title=f"{minutes:g} minutes")
    table.add_row("commands sent and accepted", str(result.steps))
    late = 100.0 * np.mean(np.array(result.late) > config.control.period_s)
    table.add_row("late by more than a period", f"{late:.2f} %")
    table.add_row("clamps from their last command", f"{1e3 * max(result.arrived):.3f} mm at most")
    table.add_row("recoveries, by itself", str(result.restarts))
    for name in result.memory:
        megabytes = result.memory[name][-1] / 2**20
        table.add_row(
            f"memory of {name}", f"{megabytes:.0f} MB, {100 * result.growth(name):+.1f} %"
        )
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
