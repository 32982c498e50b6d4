"""Training of the shape predictor (Section VI-A1), and the scores of what was trained."""

import json
import math
import pickle
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DatasetError, MissingExtra, WeightsError
from dlo_gym.geometry.se3 import Array, exp_so3, matrix_to_quaternion
from dlo_gym.interrupts import deferred_interrupt
from dlo_gym.output_folder import check_resume
from dlo_gym.rod.boundary import BoundaryDisplacement
from dlo_gym.surrogate.conditioning import N_GROUPS
from dlo_gym.surrogate.evaluation import Score, evaluate_predictor, score_table
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.rollouts import load_rollouts
from dlo_gym.surrogate.simulation import Rollouts
from dlo_gym.surrogate.weights_file import Scales, Weights, save_weights

try:
    import torch
except ModuleNotFoundError as error:
    raise MissingExtra("torch", "train") from error

from dlo_gym.surrogate.dataset import Batch, Moves, RolloutDataset, encode_plain
from dlo_gym.surrogate.network import DloNetwork, RelativeNetwork

SCHEMA = "dlo-training/1"
CHECKPOINT_EVERY = 500
VALIDATION_SIZE = 4096


@dataclass(frozen=True)
class TrainingSettings:
    """How the network is trained.

    Attributes:
        seed: of initial weights, split and batches.
        steps: of the optimiser.
        batch_size: samples per step.
        learning_rate: of Adam at the start; it falls to zero along a cosine.
        noise: standard deviation of the noise on the input's coordinates [m].
        validation_share: of the rollouts that are held back.
        hidden: width of the network.
        plain: the paper's network as written, for comparison: world axes, no first guess, no null
            action subtracted, mean squared error, constant learning rate.

    Raises:
        ValueError: naming the field.
    """

    seed: int = 0
    steps: int = 20_000
    batch_size: int = 256
    learning_rate: float = 5e-4
    noise: float = 5e-4
    validation_share: float = 0.1
    hidden: int = 256
    plain: bool = False

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if not (0.0 < self.learning_rate < math.inf and 0.0 <= self.noise < math.inf):
            raise ValueError(
                "learning_rate, noise: expected a positive and a non-negative number,"
                f" got {self.learning_rate} and {self.noise}"
            )
        if not 0.0 < self.validation_share < 1.0:
            raise ValueError(f"validation_share: expected 0 to 1, got {self.validation_share}")


class Trainer:
    """A network, its data and its optimiser, from step to step.

    Args:
        rollouts: to learn from; the last ``validation_share`` of them are held back.
        settings: how.
    """

    def __init__(self, rollouts: Rollouts, settings: TrainingSettings) -> None:
        n = len(rollouts.lengths)
        cut = n - max(1, round(settings.validation_share * n))
        if cut < 1:
            raise DatasetError(f"expected at least 2 rollouts to train and to validate, got {n}")
        self.settings = settings
        self.scales = Scales()
        self.data = RolloutDataset(
            rollouts.some(slice(cut)), noise=settings.noise, plain=settings.plain
        )
        self.held_back = rollouts.some(slice(cut, None))
        held_back = RolloutDataset(self.held_back, plain=settings.plain)
        generator = torch.Generator().manual_seed(1)
        self.validation = self._batch(held_back, VALIDATION_SIZE, generator)
        torch.manual_seed(settings.seed)
        n_nodes = rollouts.positions.shape[2]
        kind = DloNetwork if settings.plain else RelativeNetwork
        self.network: DloNetwork | RelativeNetwork = kind(n_nodes, settings.hidden)
        self.generator = torch.Generator().manual_seed(settings.seed)
        if isinstance(self.network, RelativeNetwork):
            self.network.fit(self._batch(self.data, 80 * settings.batch_size, self.generator))
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.learning_rate)
        self.step_count = 0
        self.best_loss = math.inf
        self.best = self._copy()
        self.history: list[tuple[int, float]] = []

    def step(self) -> None:
        """One step of the optimiser."""
        if not self.settings.plain:
            progress = self.step_count / self.settings.steps
            for group in self.optimiser.param_groups:
                group["lr"] = 0.5 * self.settings.learning_rate * (1 + math.cos(math.pi * progress))
        batch = self._batch(self.data, self.settings.batch_size, self.generator)
        self.optimiser.zero_grad(set_to_none=True)
        self._loss(batch).backward()
        self.optimiser.step()
        self.step_count += 1

    def validate(self) -> float:
        """The loss on what was held back; keeps the weights if they are the best so far."""
        with torch.no_grad():
            loss = float(self._loss(self.validation))
        self.history.append((self.step_count, loss))
        if loss < self.best_loss:
            self.best_loss, self.best = loss, self._copy()
        return loss

    def best_network(self) -> DloNetwork | RelativeNetwork:
        """The network with the best weights so far."""
        self.network.load_state_dict(self.best)
        return self.network

    def score(self) -> list[Score]:
        """Of the best weights on the rollouts held back."""
        network = self.best_network()
        if isinstance(network, RelativeNetwork):
            predictor = ShapePredictor(self.weights({}))
            return evaluate_predictor(
                lambda rod: predictor.for_rod(rod).predict, self.held_back, stride=5
            )
        predict = partial(predict_plain, network)
        return evaluate_predictor(lambda _: predict, self.held_back, stride=5)

    def weights(self, training: dict[str, Any]) -> Weights:
        """The best weights for a file, with how they came about."""
        network = self.best_network()
        assert isinstance(network, RelativeNetwork)
        layers, conditioning = network.export()
        return Weights(layers, self.scales, training, conditioning, "silu")

    def save(self, file: Path) -> None:
        """All that is needed to go on exactly from here, written whole or not at all.

        Raises:
            WeightsError: if it cannot be written.
        """
        content = {
            "schema": SCHEMA,
            "settings": asdict(self.settings),
            "network": self.network.state_dict(),
            "best": self.best,
            "best_loss": self.best_loss,
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "step_count": self.step_count,
            "history": self.history,
        }
        with written_aside(file, WeightsError) as part, part.open("wb") as stream:
            torch.save(content, stream)

    def load(self, file: Path) -> None:
        """Goes on from what ``save`` wrote.

        Raises:
            WeightsError: if the file is damaged or of another version.
            ValueError: if it was made with other settings.
        """
        try:
            content: dict[str, Any] = torch.load(file, weights_only=True)
        except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
            raise WeightsError(f"{file}: damaged checkpoint: {error}") from error
        schema = content.get("schema") if isinstance(content, dict) else None
        if schema != SCHEMA:
            raise WeightsError(
                f"{file}: expected a checkpoint of schema {SCHEMA}, got {schema}; train anew with"
                " --overwrite"
            )
        if content["settings"] != asdict(self.settings):
            raise ValueError(
                f"settings: {file} was made with {content['settings']}, got"
                f" {asdict(self.settings)}; resume with the same settings"
            )
        try:
            self.network.load_state_dict(content["network"])
        except RuntimeError as error:  # torch names the layers whose shapes differ
            raise WeightsError(f"{file}: a network of another shape: {error}") from error
        self.optimiser.load_state_dict(content["optimiser"])
        self.generator.set_state(content["generator"])
        self.best, self.best_loss = content["best"], content["best_loss"]
        self.step_count, self.history = content["step_count"], content["history"]

    def _batch(self, data: RolloutDataset, size: int, generator: torch.Generator) -> Batch:
        return data.sample(size, generator, self.scales)

    def _loss(self, batch: Batch) -> torch.Tensor:
        """The paper's mean squared error, or the mean distance of the nodes: the score itself."""
        if isinstance(self.network, DloNetwork):
            error = self.network(batch.state, batch.actions) - batch.change
            return 1e4 * error.square().mean()
        error = self.network(batch.state, batch.actions, batch.rods) - batch.change
        squares = error.view(len(error), -1, 3).square().sum(-1)
        return (squares + 1e-4).sqrt().mean()

    def _copy(self) -> dict[str, torch.Tensor]:
        return {name: value.clone() for name, value in self.network.state_dict().items()}


def predict_plain(
    network: DloNetwork, centerline: Array, displacement: BoundaryDisplacement
) -> Array:
    """The centerline (n, 3) [m] that the paper's network as written predicts."""
    assert displacement.right is not None
    twists = np.stack([displacement.left, displacement.right])
    moves = Moves(
        torch.from_numpy(centerline).float()[None],
        torch.zeros(1, *centerline.shape),
        torch.from_numpy(twists[:, :3]).float()[None],
        torch.from_numpy(matrix_to_quaternion(exp_so3(twists[:, 3:]))).float()[None],
        torch.ones(1),
        torch.zeros(1, N_GROUPS),
    )
    batch = encode_plain(moves)
    with torch.no_grad():
        change = network(batch.state, batch.actions)
    return centerline + change.numpy().astype(np.float64).reshape(-1, 3)


def train_surrogate(
    data: tyro.conf.Positional[Path],
    /,
    settings: tyro.conf.OmitArgPrefixes[TrainingSettings] = TrainingSettings(),
    *,
    out: Path = Path("runs/surrogate"),
    threads: int = 2,
    resume: bool = False,
    overwrite: bool = False,
    evaluate: bool = False,
    weights: Path | None = None,
) -> None:
    """Train the shape predictor on rollouts, or score one with --evaluate.

    Args:
        data: folder made by ``dlo rollouts``.
        settings: how the network is trained.
        out: folder for shape_predictor.safetensors, metrics.json and the checkpoint.
        threads: of torch.
        resume: go on from the checkpoint in OUT.
        overwrite: start anew in OUT.
        evaluate: do not train; score the weights on DATA, which they should not have seen.
        weights: file to evaluate; the shipped one by default.

    Raises:
        FileExistsError: if OUT holds a training and neither resume nor overwrite was given.
        FileNotFoundError: if there is nothing to resume.
        DatasetError: if the data are damaged or incomplete.
        WeightsError: if the checkpoint or the weights are damaged or of another version.
        ValueError: on options that conflict.
    """
    check_resume(resume=resume, overwrite=overwrite)
    if threads < 1:
        raise ValueError(f"threads: expected at least 1, got {threads}")
    if weights is not None and not evaluate:
        raise ValueError("weights: training starts from none; pass --evaluate to score a file")
    if evaluate and (resume or overwrite):
        raise ValueError("evaluate: trains nothing; expected neither resume nor overwrite")
    console = Console()
    rollouts, manifest = load_rollouts(data)
    if evaluate:
        predictor = ShapePredictor.load(weights)
        scores = evaluate_predictor(lambda rod: predictor.for_rod(rod).predict, rollouts)
        console.print(score_table(scores))
        return
    names = ("checkpoint.pt", "metrics.json", "shape_predictor.safetensors")
    checkpoint, metrics, file = (out / name for name in names)
    if any((out / name).exists() for name in names) and not (resume or overwrite):
        raise FileExistsError(f"{out} exists; pass --overwrite to start anew or --resume to go on")
    if resume and not checkpoint.exists():
        raise FileNotFoundError(f"no checkpoint.pt in {out}; there is nothing to resume")
    torch.set_num_threads(threads)
    trainer = Trainer(rollouts, settings)
    out.mkdir(parents=True, exist_ok=True)
    if resume:
        trainer.load(checkpoint)
    else:
        for name in names:
            (out / name).unlink(missing_ok=True)
    _run(trainer, checkpoint, console)
    scores = trainer.score()
    console.print(score_table(scores))
    training = {
        **asdict(settings),
        "rollouts": asdict(manifest.settings),
        "data_sha256": manifest.data_hash,
        "best_validation_loss": trainer.best_loss,
    }
    content = {
        **training,
        "validation": [asdict(score) for score in scores],
        "history": trainer.history,
    }
    with written_aside(metrics, WeightsError) as part:
        part.write_text(json.dumps(content, indent=1) + "\n")
    if not settings.plain:
        save_weights(file, trainer.weights(training))
        console.print(f"weights in {file}", highlight=False, markup=False)


def _run(trainer: Trainer, checkpoint: Path, console: Console) -> None:
    """All steps that are left, with validation and checkpoint at intervals and on Ctrl-C."""
    columns = (
        TextColumn("training"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )  # fmt: skip
    n_steps = trainer.settings.steps
    with deferred_interrupt() as interrupt, Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=n_steps, completed=trainer.step_count)
        while trainer.step_count < n_steps:
            trainer.step()
            progress.advance(task)
            if trainer.step_count % CHECKPOINT_EVERY == 0 or trainer.step_count == n_steps:
                loss = trainer.validate()
                trainer.save(checkpoint)
                progress.update(task, description=f"validation {loss:.4g}")
            if interrupt.requested:
                trainer.save(checkpoint)
                raise KeyboardInterrupt(f"--resume goes on at step {trainer.step_count}")
