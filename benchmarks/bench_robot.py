"""The emulated closed loop over sockets: deadlines, final error, servo latency, processor use."""

import time

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from dlo_gym.metrics import ptp_3d
from dlo_gym.rod.boundary import BoundaryDisplacement
from sim2real.cell import RobotCell
from sim2real.config import TEMPLATES, CellConfig
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.goals import make_goal
from sim2real.loop import ClosedLoop
from sim2real.steps import control_steps

EPISODES, STEPS = 3, 60
MOVED = 1e-5  # what counts as motion [m]


def main() -> None:
    config = CellConfig.load(TEMPLATES / "emulated.toml")
    late, errors, tracking, control, used = [], [], [], [], {}
    with EmulatedCell.of(config) as emulation, RobotCell(config) as cell:
        cell.open()
        cell.engage()
        latencies = [_servo_latency(cell) for _ in range(10)]
        processes = {name: psutil.Process(pid) for name, pid in emulation.pids.items()}
        processes["left client"] = psutil.Process(cell.arms["left"].client_pid)  # type: ignore[attr-defined]
        processes["loop"] = psutil.Process()
        home = cell.commanded
        for seed in range(EPISODES):
            goal = make_goal("sampled", config, home, seed)
            loop = ClosedLoop(config, goal)
            cell.refresh()
            for process in processes.values():
                process.cpu_percent()
            for step in control_steps(cell, loop, steps=STEPS):
                if step.accepted is None:
                    continue
                late.append(step.late)
                tracking.append(step.output.tracking_ms)
                control.append(step.output.control_ms)
            used = {name: process.cpu_percent() for name, process in processes.items()}
            errors.append(1e3 * float(ptp_3d(emulation.truth().centerline, goal).mean()))
    period = config.control.period_s
    table = Table("measure", "value", title="emulated cell, two 640x360 views, 10 Hz control")
    table.add_row("steps", str(len(late)))
    for name, limit in (("late at all", 0.0), ("late by more than a period", period)):
        table.add_row(name, f"{100.0 * np.mean(np.array(late) > limit):.1f} %")
    table.add_row("final error on the true rod", ", ".join(f"{error:.2f} mm" for error in errors))
    for name, values in (("tracking", tracking), ("control and gate", control)):
        median, p99 = np.median(values), np.quantile(values, 0.99)
        table.add_row(name, f"{median:.1f} ms (p99 {p99:.1f})")
    table.add_row(
        "servo command to first motion",
        f"{1e3 * np.median(latencies):.0f} ms (max {1e3 * max(latencies):.0f})",
    )
    for name, share in used.items():
        table.add_row(f"processor, {name}", f"{share:.0f} % of a core")
    Console().print(table)


def _servo_latency(cell: RobotCell) -> float:
    """From a command to the first reading that shows motion [s]."""
    time.sleep(0.5)
    start = cell.boundary.left[:3, 3]
    twist = np.array([0.0, 0.0, 0.005, 0.0, 0.0, 0.0])
    sent = time.monotonic()
    cell.send(cell.commanded.displaced(BoundaryDisplacement(twist, twist)), 0.1)
    while True:
        reading = cell.arms["left"].reading()
        if np.linalg.norm(cell.boundary.left[:3, 3] - start) > MOVED:
            break
        time.sleep(0.001)
    cell.send(cell.commanded.displaced(BoundaryDisplacement(-twist, -twist)), 0.1)
    return reading.stamp - sent


if __name__ == "__main__":
    main()
