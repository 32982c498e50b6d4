"""``dlo train-rl``: soft actor-critic with hindsight experience replay."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

import dlo_gym  # noqa: F401  registers the environments
from control.controller import ControlDiagnostics, Controller
from control.evaluate import gate_for, run_episode, write_metrics
from control.policy import Policy, PolicyController, feature_map
from control.policy_env import PolicyObservation
from dlo_gym.envs.actions import ClampAction
from dlo_gym.exceptions import MissingExtra
from dlo_gym.geometry.se3 import Array
from dlo_gym.interrupts import Interrupt, deferred_interrupt
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.state import ShapeEstimate

try:
    import torch
    from stable_baselines3 import SAC, HerReplayBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import configure
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    from control.rl_checkpoints import load_checkpoint, prepare_folder, save_checkpoint
except ImportError as error:
    raise MissingExtra("stable-baselines3", "train") from error

ENV_IDS = {"state": "dlo_gym/ShapeControl-v0", "tracked": "dlo_gym/ShapeControlTracked-v0"}
# Seeds of episodes that no training episode shares: to choose the best policy, to report it.
VALIDATION_SEED, TEST_SEED = 1_000_000, 2_000_000


@dataclass(frozen=True)
class TrainingConfig:
    """What a run was asked to do; written beside its results.

    Raises:
        ValueError: naming the setting.
    """

    observer: str
    seed: int
    goal_distance: tuple[float, float]
    hidden: tuple[int, ...]
    learning_rate: float
    batch_size: int
    discount: float
    gradient_steps: int
    buffer_size: int
    learning_starts: int

    def __post_init__(self) -> None:
        if self.observer not in ENV_IDS:
            raise ValueError(f"observer: expected state or tracked, got {self.observer!r}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")
        if not 0.0 < self.discount < 1.0:
            raise ValueError(f"discount: expected 0 < gamma < 1, got {self.discount}")
        for name in ("learning_rate", "batch_size", "gradient_steps"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: expected positive layer sizes, got {self.hidden}")
        # Hindsight needs a finished episode to draw goals from.
        episode = gym.spec(ENV_IDS[self.observer]).max_episode_steps or 0
        for name in ("learning_starts", "buffer_size"):
            if getattr(self, name) <= episode:
                raise ValueError(
                    f"{name}: expected more than the {episode} steps of an episode,"
                    f" got {getattr(self, name)}"
                )


def train_rl(
    out: Path,
    *,
    observer: Literal["state", "tracked"] = "state",
    steps: int = 20_000,
    seed: int = 0,
    goal_distance: tuple[float, float] = (0.06, 0.25),
    hidden: tuple[int, ...] = (256, 256),
    learning_rate: float = 1e-3,
    batch_size: int = 256,
    discount: float = 0.9,
    gradient_steps: int = 1,
    buffer_size: int = 100_000,
    learning_starts: int = 1_000,
    eval_every: int = 2_500,
    eval_episodes: int = 10,
    test_episodes: int = 30,
    checkpoint_every: int = 5_000,
    threads: int = 1,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Train a shape-control policy with SAC and HER.

    Leaves in the output folder: policy.safetensors, the best policy on validation episodes, for
    "dlo control --controller rl --policy"; metrics.json, its final errors on held-out test
    episodes beside those of the untrained policy and of holding still; evaluations.jsonl,
    tensorboard/, and the newest checkpoint with its replay buffer. Ctrl-C saves a checkpoint,
    --resume goes on from the newest one. Resume only folders of your own: a replay buffer is a
    pickle.

    Args:
        out: output folder.
        observer: what the policy sees: the simulator's state, or the tracker's estimate.
        steps: environment steps in all, those before a resume included.
        seed: of networks, exploration and training episodes.
        goal_distance: smallest and largest mean node distance of the training goals [m].
        hidden: sizes of the hidden layers of actor and critics.
        learning_rate: of Adam.
        batch_size: transitions in one gradient step.
        discount: gamma.
        gradient_steps: after each environment step.
        buffer_size: transitions kept for replay.
        learning_starts: environment steps with random actions before learning begins.
        eval_every: environment steps between evaluations.
        eval_episodes: validation episodes in each.
        test_episodes: held-out episodes at the end.
        checkpoint_every: environment steps between checkpoints.
        threads: of torch.
        resume: go on from the newest checkpoint in the output folder.
        overwrite: replace an output folder that holds nothing but a former training.
    """
    config = TrainingConfig(
        observer, seed, goal_distance, hidden, learning_rate, batch_size, discount,
        gradient_steps, buffer_size, learning_starts,
    )  # fmt: skip
    for name, value in (
        ("steps", steps), ("eval_every", eval_every), ("eval_episodes", eval_episodes),
        ("test_episodes", test_episodes), ("checkpoint_every", checkpoint_every),
        ("threads", threads),
    ):  # fmt: skip
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    console = Console()
    torch.set_num_threads(threads)
    env = PolicyObservation(gym.make(ENV_IDS[observer], goal_distance=goal_distance))
    test_env = gym.make(ENV_IDS[observer])
    prepare_folder(out, asdict(config), resume=resume, overwrite=overwrite)
    action: ClampAction = env.unwrapped.clamp_action  # type: ignore[attr-defined]

    if resume:
        model, best_error = load_checkpoint(out, env, seed)
        if model.num_timesteps > steps:
            raise ValueError(f"steps: {out} has {model.num_timesteps} already, got {steps}")
    else:
        model, best_error = _new_model(env, config), float("inf")
        export_policy(model, action).save(out / "untrained.safetensors", steps="0", seed=str(seed))
    model.set_logger(configure(str(out / "tensorboard"), ["tensorboard"]))

    with deferred_interrupt() as interrupt, _progress(console) as progress:
        log = TrainingLog(
            out, test_env, action, progress, interrupt, steps, best_error,
            eval_every, eval_episodes, checkpoint_every,
        )  # fmt: skip
        remaining = steps - model.num_timesteps
        model.learn(remaining, callback=log, reset_num_timesteps=False, log_interval=10)
        log.finish()
    if interrupt.requested:
        raise KeyboardInterrupt(f"--resume goes on at step {model.num_timesteps}")

    seeds = range(TEST_SEED, TEST_SEED + test_episodes)
    results = {
        "hold still": final_errors(test_env, HoldStill(), seeds),
        "untrained policy": final_errors(
            test_env, PolicyController(out / "untrained.safetensors"), seeds
        ),
        "trained policy": final_errors(
            test_env, PolicyController(out / "policy.safetensors"), seeds
        ),
    }
    threshold = test_env.unwrapped.config.success_threshold  # type: ignore[attr-defined]
    scores = {
        name: {
            "final_shape_error_mm": float(1e3 * errors.mean()),
            "final_shape_error_median_mm": float(1e3 * np.median(errors)),
            "success_rate": float((errors <= threshold).mean()),
        }
        for name, errors in results.items()
    }
    metrics: dict[str, Any] = {name.replace(" ", "_"): score for name, score in scores.items()}
    metrics |= {"steps": model.num_timesteps, "test_seeds": [seeds.start, seeds.stop - 1]}
    write_metrics(out / "metrics.json", metrics)
    table = Table("", "mean final error", "median", "success", title=f"{test_episodes} episodes")
    for name, score in scores.items():
        table.add_row(
            name,
            f"{score['final_shape_error_mm']:.1f} mm",
            f"{score['final_shape_error_median_mm']:.1f} mm",
            f"{100 * score['success_rate']:.0f} %",
        )
    console.print(table)
    console.print(
        f"policy: {out / 'policy.safetensors'}", highlight=False, markup=False, soft_wrap=True
    )
    env.close()
    test_env.close()


class LinearFeatures(BaseFeaturesExtractor):
    """The fixed map of ``control.policy.feature_map`` in front of actor and critics."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        matrix, offset = feature_map()
        super().__init__(observation_space, len(offset))
        self.register_buffer("matrix", torch.as_tensor(matrix, dtype=torch.float32))
        self.register_buffer("offset", torch.as_tensor(offset, dtype=torch.float32))

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        keys = ("achieved_goal", "desired_goal", "observation")
        inputs = torch.cat([observations[key] for key in keys], dim=1)
        return inputs @ self.matrix.T + self.offset  # type: ignore[operator]


def export_policy(model: SAC, action: ClampAction) -> Policy:
    """The actor's mean as a NumPy policy, with the fixed features folded into its first layer."""
    actor = model.policy.actor
    layers = [layer for layer in actor.latent_pi if isinstance(layer, torch.nn.Linear)]
    layers.append(actor.mu)  # type: ignore[arg-type]
    weights = [layer.weight.detach().numpy().astype(np.float64) for layer in layers]
    biases = [layer.bias.detach().numpy().astype(np.float64) for layer in layers]
    matrix, offset = feature_map()
    biases[0] = biases[0] + weights[0] @ offset
    weights[0] = weights[0] @ matrix
    return Policy(weights, biases, action)


class HoldStill:
    """The controller to beat first: does nothing."""

    diagnostics = ControlDiagnostics()

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        pass

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        return BoundaryDisplacement.zero()


def final_errors(env: gym.Env, controller: Controller, seeds: Sequence[int]) -> Array:
    """Error of the true shape at the end of one episode per seed (n,) [m], run as by
    ``dlo control``."""
    gate = gate_for(env.unwrapped.config)  # type: ignore[attr-defined]
    errors = []
    for seed in seeds:
        *_, last = run_episode(env, controller, gate, seed=seed)
        errors.append(last.shape_error)
    return np.array(errors)


class TrainingLog(BaseCallback):
    """Shows progress, evaluates, keeps the best policy, writes checkpoints."""

    def __init__(
        self,
        out: Path,
        eval_env: gym.Env,
        action: ClampAction,
        progress: Progress,
        interrupt: Interrupt,
        steps: int,
        best_error: float,
        eval_every: int,
        eval_episodes: int,
        checkpoint_every: int,
    ) -> None:
        super().__init__()
        self.out, self.eval_env, self.action = out, eval_env, action
        self.progress, self.interrupt = progress, interrupt
        self.best_error, self.evaluated_at = best_error, -1
        self.eval_every, self.checkpoint_every = eval_every, checkpoint_every
        self.seeds = range(VALIDATION_SEED, VALIDATION_SEED + eval_episodes)
        self.bar = progress.add_task("training", total=steps, note="")

    def _on_step(self) -> bool:
        if self.interrupt.requested:
            return False
        self.progress.update(self.bar, completed=self.num_timesteps)
        if self.num_timesteps % self.eval_every == 0:
            self._evaluate()
        if self.num_timesteps % self.checkpoint_every == 0:
            save_checkpoint(self.model, self.out, self.best_error)  # type: ignore[arg-type]
        return True

    def finish(self) -> None:
        """The last evaluation and checkpoint, also after an interruption."""
        if not self.interrupt.requested and self.evaluated_at != self.num_timesteps:
            self._evaluate()
        save_checkpoint(self.model, self.out, self.best_error)  # type: ignore[arg-type]

    def _evaluate(self) -> None:
        self.evaluated_at = self.num_timesteps
        policy = export_policy(self.model, self.action)  # type: ignore[arg-type]
        error = float(final_errors(self.eval_env, PolicyController(policy), self.seeds).mean())
        self.logger.record("eval/final_shape_error_mm", 1e3 * error)
        with (self.out / "evaluations.jsonl").open("a") as file:
            entry = {"steps": self.num_timesteps, "final_shape_error_mm": 1e3 * error}
            file.write(json.dumps(entry) + "\n")
        if error < self.best_error:
            self.best_error = error
            policy.save(self.out / "policy.safetensors", steps=str(self.num_timesteps))
        note = f"validation {1e3 * error:.1f} mm, best {1e3 * self.best_error:.1f} mm"
        self.progress.update(self.bar, note=note)


def _new_model(env: gym.Env, config: TrainingConfig) -> SAC:
    return SAC(
        "MultiInputPolicy",
        env,
        learning_rate=config.learning_rate,
        buffer_size=config.buffer_size,
        learning_starts=config.learning_starts,
        batch_size=config.batch_size,
        gamma=config.discount,
        gradient_steps=config.gradient_steps,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={
            "n_sampled_goal": 1,
            "goal_selection_strategy": "future",
            "copy_info_dict": True,
        },
        policy_kwargs={
            "net_arch": list(config.hidden),
            "features_extractor_class": LinearFeatures,
        },
        seed=config.seed,
        device="cpu",
    )


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=console,
    )  # fmt: skip
