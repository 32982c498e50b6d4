"""The closed loop: any controller on any environment through the safety gate, and its report."""

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import dlo_gym  # noqa: F401  (registers the environments)
from control.controller import Controller
from control.models import HorizonModel, RodModel, SurrogateModel
from control.mpc import ShapeMPC
from control.policy import PolicyController
from control.problem import MpcConfig
from control.safety import SafetyGate, SafetyLimits
from control.servo import EndServo, OverServo
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.envs.shape_env import ShapeControlEnv
from dlo_gym.envs.wrap_bar_env import WrapBarEnv
from dlo_gym.exceptions import SafetyStop, SolverFailed
from dlo_gym.executor import in_order, run_tasks
from dlo_gym.geometry.se3 import Array
from dlo_gym.output_folder import check_output_folder
from dlo_gym.rod.state import ShapeEstimate
from dlo_gym.scene.arms import DualArm

OBSERVERS = {"state": "privileged", "tracked": "tracking.observer:TrackerObserver"}
# How much earlier than the environment the gate says overstretched, in lengths of the rod.
STRETCH_RESERVE = 0.005
# How much earlier it says that arms collide [m].
CLEARANCE_RESERVE = 0.001


@dataclass(frozen=True, eq=False)
class Step:
    """The cell after one control step; the first of an episode is the start.

    Attributes:
        stamp: [s].
        truth: (n_nodes, 3) the rod's true centerline [m].
        goal: (n_nodes, 3) [m].
        estimate: what the observer made of it.
        displacement: (12,) motion of the clamps that was made, [m] and [rad], world axes.
        shape_error: of the true rod to the goal, mean over the nodes [m].
        tracking_ptp3d: of the estimate to the true rod, mean over the nodes [m].
        occlusion_ratio: share of the nodes hidden, over all views.
        success: whether ``shape_error`` is within the environment's threshold.
        reasons: limits by which the safety gate cut the command.
        status: of the controller.
        termination: why the episode ended early, or "".
        control_ms, tracking_ms: time of the controller and of the observer; None where there was
            none.
    """

    stamp: float
    truth: Array
    goal: Array
    estimate: ShapeEstimate
    displacement: Array
    shape_error: float
    tracking_ptp3d: float
    occlusion_ratio: float
    success: bool
    reasons: tuple[str, ...] = ()
    status: str = "ok"
    termination: str = ""
    control_ms: float | None = None
    tracking_ms: float | None = None


def gate_for(config: ShapeEnvConfig) -> SafetyGate:
    """A safety gate whose step limits just hold the environment's action box, and whose other
    limits are the environment's own.

    It knows the arms exactly if the environment does (``check_arms``).
    """
    axes, turns = (2.0, 1.0) if config.planar else (3.0, 3.0 if config.axial_rotation else 2.0)
    return SafetyGate(
        SafetyLimits(
            max_translation_step=sqrt(axes) * config.max_translation_step,
            max_rotation_step=sqrt(turns) * config.max_rotation_step,
            control_period=config.control_step,
            rod_length=config.properties.length,
            overstretch_margin=1.0 - config.max_stretch + STRETCH_RESERVE,
            min_gripper_distance=config.min_gripper_distance,
            workspace=config.workspace,
            max_joint_speed=inf,
            min_arm_clearance=CLEARANCE_RESERVE,
        ),
        DualArm() if config.check_arms else None,
    )


def run_episode(
    env: gym.Env,
    controller: Controller,
    gate: SafetyGate,
    *,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    max_steps: int | None = None,
) -> Iterator[Step]:
    """Runs one episode, yielding its start and then every control step as it is made.

    A controller that gives up or a gate that stops ends the episode with ``termination``
    ``"solver_failed"`` or ``"safety_stop"``.

    Args:
        env: a shape-control environment, which may be wrapped.
        controller: is reset here.
        gate: is reset here; every command passes it.
        seed, options: for ``env.reset``.
        max_steps: ends the episode; the environment's own time limit when None.
    """
    cell_env = _shape_env(env)
    _, info = env.reset(seed=seed, options=options)
    goal = cell_env.goal.copy()
    controller.reset(goal, cell_env.cell.boundary, cell_env.cell.properties)
    gate.reset()
    yield _step(cell_env, goal, info)
    for _ in range(max_steps or 10**9):
        boundary = cell_env.cell.boundary
        started = perf_counter()
        try:
            command = controller.control(cell_env.estimate, boundary, goal)
            control_ms = 1e3 * (perf_counter() - started)
            decision = gate.check(command, boundary, cell_env.cell.joint_angles)
        except (SolverFailed, SafetyStop) as error:
            name = "solver_failed" if isinstance(error, SolverFailed) else "safety_stop"
            still = info | {"displacement": np.zeros(12), "termination": name}
            yield _step(cell_env, goal, still, status=str(error))
            return
        action = cell_env.displacement_to_action(decision.displacement)
        _, _, terminated, truncated, info = env.step(action)
        yield _step(
            cell_env,
            goal,
            info,
            reasons=decision.reasons,
            status=controller.diagnostics.status,
            control_ms=control_ms,
            tracking_ms=cell_env.estimate.timings_ms.get("total"),
        )
        if terminated or truncated:
            return


def _step(env: ShapeControlEnv, goal: Array, info: dict[str, Any], **of_command: Any) -> Step:
    return Step(
        stamp=env.cell.stamp,
        truth=env.cell.rod_state.positions.copy(),
        goal=goal,
        estimate=env.estimate,
        displacement=np.array(info["displacement"]),
        shape_error=info["shape_error"],
        tracking_ptp3d=info["tracking_ptp3d"],
        occlusion_ratio=info["occlusion_ratio"],
        success=info["success"],
        termination=info["termination"],
        **of_command,
    )


def episode_metrics(steps: Sequence[Step]) -> dict[str, Any]:
    """What is reported of one episode; lengths in mm, times in ms."""
    errors = [step.shape_error for step in steps]
    reached = [i for i, step in enumerate(steps) if step.success]
    return {
        "initial_shape_error_mm": 1e3 * errors[0],
        "final_shape_error_mm": 1e3 * errors[-1],
        "smallest_shape_error_mm": 1e3 * min(errors),
        "tracking_ptp3d_mm": 1e3 * _mean([step.tracking_ptp3d for step in steps]),
        "occlusion_percent": 100.0 * _mean([step.occlusion_ratio for step in steps]),
        "success": bool(steps[-1].success and not steps[-1].termination),
        "steps": len(steps) - 1,
        "steps_to_success": reached[0] if reached else None,
        "termination": steps[-1].termination,
        "control_ms": _times([step.control_ms for step in steps]),
        "tracking_ms": _times([step.tracking_ms for step in steps]),
        "held_still": sum(step.status != "ok" for step in steps),
        "safety_cuts": dict(Counter(reason for step in steps for reason in step.reasons)),
    }


def overall_metrics(episodes: Sequence[Sequence[Step]]) -> dict[str, Any]:
    """Means over episodes, times over all steps, and every episode's own metrics.

    ``success`` is true if every episode succeeded; ``success_rate`` is the share that did.
    """
    each = [episode_metrics(steps) for steps in episodes]
    every_step = [step for steps in episodes for step in steps]
    means = {
        name: _mean([episode[name] for episode in each])
        for name in (
            "initial_shape_error_mm",
            "final_shape_error_mm",
            "tracking_ptp3d_mm",
            "occlusion_percent",
        )
    }
    return means | {
        "worst_final_shape_error_mm": max(episode["final_shape_error_mm"] for episode in each),
        "success": all(episode["success"] for episode in each),
        "success_rate": _mean([episode["success"] for episode in each]),
        "control_ms": _times([step.control_ms for step in every_step]),
        "tracking_ms": _times([step.tracking_ms for step in every_step]),
        "episodes": each,
    }


def control(
    *,
    controller: Literal["mpc", "servo", "over", "rl"] = "mpc",
    env: str = "dlo_gym/ShapeControl-v0",
    observer: Literal["state", "tracked"] | None = None,
    model: Literal["surrogate", "rod"] | None = None,
    episodes: int = 5,
    seed: int = 0,
    max_steps: int | None = None,
    policy: Path | None = None,
    workers: int = 1,
    ray_address: str | None = None,
    out: Path = Path("out/control"),
    overwrite: bool = False,
) -> None:
    """Run a controller on an environment, every command through the safety gate, and report.

    Prints a table with one row per episode and writes metrics.json, which is kept up to date
    after every episode, so that an interrupted run loses nothing that was finished.

    Args:
        controller: mpc; servo, which moves the grippers straight to the goal's ends; over, which
            lifts the cable over what stands in between; or rl for a trained policy.
        env: id of a shape-control environment.
        observer: state for the simulator's own state, tracked for the tracker on rendered views;
            what the environment id says when omitted.
        model: what the MPC plans on: the trained surrogate, or the rod itself; the surrogate when
            omitted, but the rod where its right end is free.
        episodes: how many.
        seed: of the first episode; each next one takes the next seed.
        max_steps: per episode; the environment's time limit when omitted.
        policy: file of the trained policy, for rl.
        workers: processes that run the episodes; 0 for one per core. The results are the same, but
            times are measured undisturbed by one alone.
        ray_address: run the episodes on the Ray cluster there, host:port; "local" starts one here.
            Needs  pip install 'dlo-gym[scale]'.
        out: folder for metrics.json.
        overwrite: replace the metrics.json of a former run in the output folder.
    """
    if episodes < 1:
        raise ValueError(f"episodes: expected at least 1, got {episodes}")
    if seed < 0:
        raise ValueError(f"seed: expected 0 or more, got {seed}")
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps: expected at least 1, got {max_steps}")
    if policy is not None and controller != "rl":
        raise ValueError(f"policy: the {controller} controller takes none; pass --controller rl")
    if model is not None and controller != "mpc":
        raise ValueError(f"model: the {controller} controller takes none; pass --controller mpc")
    check_output_folder(out, ("metrics.json*",), overwrite=overwrite)
    existed = out.exists()
    finished: list[list[Step]] = []
    environment = make_env(env, observer)
    try:
        config = _shape_env(environment).config
        gate = gate_for(config)
        driver = make_controller(controller, gate.limits, config, model=model, policy=policy)
        out.mkdir(parents=True, exist_ok=True)
        settings = {"controller": controller, "env": env, "observer": config.observer, "seed": seed}
        if controller == "mpc":
            settings["model"] = model or default_model(config)
        console = Console()
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task("episodes", total=episodes)

            def watched(index: int) -> list[Step]:
                steps = []
                for step in run_episode(
                    environment, driver, gate, seed=seed + index, max_steps=max_steps
                ):
                    steps.append(step)
                    error = f"episode {index}: {1e3 * step.shape_error:6.2f} mm"
                    progress.update(task, description=error)
                return steps

            if workers == 1 and ray_address is None:
                made = (watched(index) for index in range(episodes))
            else:
                arguments = (env, observer, controller, model, policy, max_steps)
                tasks = [(*arguments, seed + index) for index in range(episodes)]
                made = in_order(
                    run_tasks(play_episode, tasks, workers=workers, ray_address=ray_address)
                )
            for steps in made:
                finished.append(steps)
                progress.advance(task)
                write_metrics(out / "metrics.json", settings | overall_metrics(finished))
    except KeyboardInterrupt:
        kept = f"{out / 'metrics.json'} has {len(finished)}" if finished else "none was finished"
        raise KeyboardInterrupt(f"of {episodes} episodes, {kept}") from None
    finally:
        environment.close()
        if not finished and not existed and out.is_dir():
            out.rmdir()
    console.print(_table(overall_metrics(finished), seed))
    console.print(f"written: {out / 'metrics.json'}", highlight=False, markup=False, soft_wrap=True)


def play_episode(
    env: str,
    observer: str | None,
    controller: str,
    model: str | None,
    policy: Path | None,
    max_steps: int | None,
    seed: int,
) -> list[Step]:
    """The steps of one episode, with an environment and a controller of its own."""
    environment = make_env(env, observer)
    try:
        config = _shape_env(environment).config
        gate = gate_for(config)
        driver = make_controller(controller, gate.limits, config, model=model, policy=policy)
        return list(run_episode(environment, driver, gate, seed=seed, max_steps=max_steps))
    finally:
        environment.close()


def make_env(name: str, observer: str | None = None, **options: Any) -> gym.Env:
    """The environment ``name``, observing as ``observer`` says (``"state"``, ``"tracked"``).

    Raises:
        ValueError: if there is no such environment or observer, or it takes no such option.
    """
    if observer is not None:
        if observer not in OBSERVERS:
            raise ValueError(f"observer: expected one of {', '.join(OBSERVERS)}, got {observer!r}")
        options["observer"] = OBSERVERS[observer]
    try:
        return gym.make(name, **options)
    except (gym.error.Error, ModuleNotFoundError, TypeError) as error:  # TypeError: of its options
        shipped = [known for known in gym.registry if known.startswith("dlo_gym/")]
        raise ValueError(
            f"env: cannot make {name!r}: {error}; this package has {', '.join(shipped)}"
        ) from error


def make_controller(
    name: str,
    limits: SafetyLimits,
    config: ShapeEnvConfig,
    *,
    model: str | None = None,
    policy: Path | None = None,
) -> Controller:
    """The controller ``name`` for environments with ``config``.

    Args:
        name: ``"mpc"``, ``"servo"``, ``"over"`` or ``"rl"``.
        limits: of the safety gate.
        config: of the environment.
        model: ``"surrogate"`` or ``"rod"``, for the MPC; ``default_model(config)`` when omitted.
        policy: file of the trained policy, for ``"rl"``.

    Raises:
        ValueError: on an unknown name, if ``rl`` comes without a policy, or if model or policy are
            not for such a rod and such grippers.
        WeightsError: if the weights of the surrogate or the policy are missing or damaged.
    """
    if name == "mpc":
        if config.axial_rotation:  # of the three turns of an action the MPC plans two
            limits = replace(limits, max_rotation_step=sqrt(2.0) * config.max_rotation_step)
        settings = MpcConfig(n_clamps=config.n_clamps, planar=config.planar)
        return ShapeMPC(_model(model or default_model(config), config), limits, settings)
    if name == "servo":
        return EndServo(limits, planar=config.planar)
    if name == "over":
        return OverServo(limits, planar=config.planar)
    if name == "rl":
        if policy is None:
            raise ValueError("policy: the rl controller needs the file of a trained policy")
        controller = PolicyController(policy)
        moves = {
            "n_clamps": config.n_clamps,
            "planar": config.planar,
            "axial_rotation": config.axial_rotation,
        }
        for what, expected in moves.items():
            if (got := getattr(controller.policy.action, what)) != expected:
                raise ValueError(
                    f"policy: {policy}: expected one with {what} {expected}, as the environment"
                    f" has, got {got}"
                )
        return controller
    raise ValueError(f"controller: expected mpc, servo, over or rl, got {name!r}")


def default_model(config: ShapeEnvConfig) -> str:
    """What the MPC plans on where nothing else is asked for."""
    return "rod" if config.free_end else "surrogate"


def _model(name: str, config: ShapeEnvConfig) -> HorizonModel:
    if name == "rod":
        return RodModel(config.n_elements)
    if name != "surrogate":
        raise ValueError(f"model: expected surrogate or rod, got {name!r}")
    if config.free_end:
        raise ValueError(
            "model: expected rod where the right end is free, got surrogate, which knows rods"
            " held at both ends"
        )
    from dlo_gym.surrogate.predictor import ShapePredictor

    predictor = ShapePredictor.load()
    if predictor.n_nodes != config.n_nodes:
        raise ValueError(
            f"model: expected rod for a rod of n_elements {config.n_elements}, got surrogate,"
            f" which knows {predictor.n_nodes - 1} elements"
        )
    return SurrogateModel(predictor)


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Write JSON so that the file is always whole; NaN becomes null."""
    partial = path.with_name(path.name + ".part")
    partial.write_text(json.dumps(_without_nan(metrics), indent=2) + "\n")
    os.replace(partial, path)


def _shape_env(env: gym.Env) -> ShapeControlEnv:
    inner = env.unwrapped
    if not isinstance(inner, ShapeControlEnv) or isinstance(inner, WrapBarEnv):
        raise ValueError(
            f"env: expected a task whose goal is a shape, got a {type(inner).__name__}"
        )
    return inner


def _table(metrics: dict[str, Any], seed: int) -> Table:
    table = Table(
        title="mean node errors of the true rod and of the tracker in mm, median (p99) times in ms",
        box=box.SIMPLE_HEAD,
        padding=0,
        collapse_padding=True,
    )
    for name in ("seed", "start", "end", "tracker", "hidden", "steps", "to goal"):
        table.add_column(name, justify="right")
    for name in ("control", "tracking"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("result")
    for index, episode in enumerate(metrics["episodes"]):
        result = "reached" if episode["success"] else (episode["termination"] or "not reached")
        to_goal = episode["steps_to_success"]
        numbers = [str(episode["steps"]), "-" if to_goal is None else str(to_goal)]
        table.add_row(str(seed + index), *_columns(episode, numbers), result)
    share = f"{100 * metrics['success_rate']:.0f} %"
    table.add_section()
    table.add_row("all", *_columns(metrics, ["", ""]), share)
    return table


def _columns(metrics: dict[str, Any], counts: list[str]) -> list[str]:
    return [
        f"{metrics['initial_shape_error_mm']:.1f}",
        f"{metrics['final_shape_error_mm']:.2f}",
        f"{metrics['tracking_ptp3d_mm']:.2f}",
        f"{metrics['occlusion_percent']:.0f} %",
        *counts,
        *[_median_and_p99(metrics[name]) for name in ("control_ms", "tracking_ms")],
    ]


def _median_and_p99(times: dict[str, float] | None) -> str:
    return "-" if times is None else f"{times['median']:.1f} ({times['p99']:.1f})"


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _times(values: Sequence[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"median": float(np.median(known)), "p99": float(np.percentile(known, 99))}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
