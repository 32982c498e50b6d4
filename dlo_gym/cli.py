"""The ``dlo`` command: one subcommand per job, imported only when asked for."""

import os
import sys
from importlib import import_module
from importlib.metadata import version

import tyro
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from dlo_gym.exceptions import DloError

# name: (where the function is, what it does); the function's own docstring is its --help.
COMMANDS = {
    "demo": ("control.demo:demo", "steer a cable to a goal shape by MPC on tracked images"),
    "control": ("control.evaluate:control", "run a controller on an environment and report"),
    "track": ("tracking.evaluate:track", "track the cable in a recording and report"),
    "rollouts": ("dlo_gym.surrogate.rollouts:rollouts", "simulate rod rollouts for training"),
    "train-surrogate": ("dlo_gym.surrogate.train:train_surrogate", "train the shape predictor"),
    "evaluate-surrogate": (
        "dlo_gym.surrogate.sweep:evaluate_surrogate",
        "score shape predictors on rods of other stiffness",
    ),
    "train-rl": ("control.rl:train_rl", "train a policy with SAC and HER"),
    "identify": (
        "sim2real.identify:identify",
        "find stiffness, rest curvature and length of a recorded cable",
    ),
    "robot init": ("sim2real.templates:init", "write a cell file to start from"),
    "robot check": ("sim2real.check:check", "connect to a cell, check every part, move nothing"),
    "robot run": ("sim2real.run:run", "steer the cable of a cell to a goal shape"),
    "robot record": ("sim2real.record:record", "record a cell without controlling it"),
    "robot replay": ("sim2real.replay:replay", "run tracker and controller again on a recording"),
    "robot emulate": ("sim2real.emulator.emulate:emulate", "emulate two UR5e controllers"),
    "robot demo": ("sim2real.demo:demo", "a shape task through two emulated UR5e"),
    "robot board": ("sim2real.calibration.board:board", "draw a calibration board for printing"),
    "robot calibrate": ("sim2real.calibration.calibrate:calibrate", "calibrate cameras and bases"),
    "robot verify-calibration": (
        "sim2real.calibration.verify:verify_calibration",
        "measure whether a cell's calibration still holds",
    ),
}


def main(arguments: list[str] | None = None) -> int:
    """Runs one subcommand; returns the process's exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    console = Console(stderr=True)
    if not arguments or arguments[0] in ("-h", "--help"):
        _list("")
        return 0
    name, *rest = arguments
    if name == "--version":
        print(version("dlo-gym"))
        return 0
    if any(known.startswith(f"{name} ") for known in COMMANDS):  # a group of commands
        if not rest or rest[0] in ("-h", "--help"):
            _list(f"{name} ")
            return 0
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in COMMANDS:
        console.print(f"dlo: no command {name!r}; there are: {', '.join(COMMANDS)}", style="red")
        return 2
    module, function = COMMANDS[name][0].split(":")
    try:
        command = getattr(import_module(module), function)
        _one_thread_for_blas()
        tyro.cli(command, prog=f"dlo {name}", args=rest)
    except (DloError, ValueError, OSError) as error:
        console.print(f"dlo {name}: {error}", style="red", highlight=False, markup=False)
        return 1
    except KeyboardInterrupt as interrupt:
        said = f"; {interrupt}" if str(interrupt) else ""
        console.print(f"dlo {name}: interrupted{said}", style="yellow", markup=False)
        return 130
    return 0


def _one_thread_for_blas() -> None:
    """NumPy's matrices are small here: more threads only wait for each other, and for a control
    loop that shares its cores with two robots they wait too long."""
    threadpool_limits(1, user_api="blas")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes it starts


def _list(group: str) -> None:
    table = Table("command", "what it does", title=f"dlo {group}COMMAND [--help]", box=None)
    for name, (_, summary) in COMMANDS.items():
        if name.startswith(group):
            table.add_row(name, summary)
    Console().print(table)
