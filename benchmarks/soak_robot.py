"""The emulated closed loop for a long time: memory, deadlines, commands, reconnections.

``make soak`` runs 30 minutes; a test runs a minute of it.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import psutil
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from sim2real.cell import RobotCell
from sim2real.config import TEMPLATES, CellConfig
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.goals import make_goal
from sim2real.loop import ClosedLoop
from sim2real.steps import control_steps

EPISODE = 60  # control steps to one goal
SETTLED = 1.0  # after the last command of an episode [s]
WARM = 0.3  # share of the run after which memory counts


@dataclass
class Soak:
    """What a long run came to.

    Attributes:
        steps: commands sent and accepted.
        late: of each step [s].
        arrived: after each episode, how far a clamp is from where it was last sent [m].
        restarts: how often the loop had to start anew.
        memory: per process, resident bytes over time.
    """

    steps: int = 0
    late: list[float] = field(default_factory=list)
    arrived: list[float] = field(default_factory=list)
    restarts: int = 0
    memory: dict[str, list[int]] = field(default_factory=dict)

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
        processes = {name: psutil.Process(pid) for name, pid in emulation.pids.items()}
        processes["loop"] = psutil.Process()
        for side, arm in robot.arms.items():
            processes[f"{side} client"] = psutil.Process(arm.client_pid)  # type: ignore[attr-defined]
        goal_seed = 0
        while time.monotonic() < end:
            goal = make_goal("sampled", config, robot.commanded, goal_seed)
            goal_seed += 1
            for step in control_steps(robot, ClosedLoop(config, goal), steps=EPISODE):
                result.steps += 1
                result.late.append(step.late)
                result.restarts += step.begins
                if result.steps % 10 == 0:
                    for name, process in processes.items():
                        result.memory.setdefault(name, []).append(process.memory_info().rss)
                yield result
            robot.wait_until(time.monotonic() + SETTLED)
            away = robot.boundary.displacement_to(robot.commanded).vector.reshape(2, 2, 3)
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
    table.add_row("started anew", str(result.restarts))
    for name in result.memory:
        megabytes = result.memory[name][-1] / 2**20
        table.add_row(
            f"memory of {name}", f"{megabytes:.0f} MB, {100 * result.growth(name):+.1f} %"
        )
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
