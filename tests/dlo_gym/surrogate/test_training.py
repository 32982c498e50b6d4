import dataclasses
import json
import signal
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from dlo_gym.exceptions import DatasetError, WeightsError  # noqa: E402
from dlo_gym.geometry.se3 import exp_so3, log_so3, quaternion_to_matrix  # noqa: E402
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses  # noqa: E402
from dlo_gym.rod.initial_shapes import random_boundary  # noqa: E402
from dlo_gym.rod.properties import RodProperties  # noqa: E402
from dlo_gym.rod.rod import CosseratRod  # noqa: E402
from dlo_gym.surrogate import train as module  # noqa: E402
from dlo_gym.surrogate.dataset import (  # noqa: E402
    Moves,
    RolloutDataset,
    _mirror_some,
    encode,
    heading,
    relative_quaternion,
    rotate,
)
from dlo_gym.surrogate.network import DloNetwork, RelativeNetwork  # noqa: E402
from dlo_gym.surrogate.predictor import CLAMP_NODES, ShapePredictor  # noqa: E402
from dlo_gym.surrogate.rollouts import rollouts  # noqa: E402
from dlo_gym.surrogate.simulation import (  # noqa: E402
    Rollouts,
    RolloutSettings,
    simulate_rollout,
)
from dlo_gym.surrogate.train import Trainer, TrainingSettings, train_surrogate  # noqa: E402
from dlo_gym.surrogate.weights_file import Scales, Weights, load_weights  # noqa: E402

SHORT = TrainingSettings(steps=12, batch_size=16, hidden=16)


@pytest.fixture(scope="module")
def data(tmp_path_factory, small_settings):
    folder = tmp_path_factory.mktemp("rollouts") / "data"
    rollouts(folder, dataclasses.replace(small_settings, n_rollouts=4), workers=1)
    return folder


def simulate_all(settings: RolloutSettings) -> Rollouts:
    return Rollouts.joined(simulate_rollout(settings, i) for i in range(settings.n_rollouts))


@pytest.fixture(autouse=True)
def small_validation(monkeypatch):
    monkeypatch.setattr(module, "VALIDATION_SIZE", 64)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class TestDataset:
    def test_rotations_agree_with_scipy(self):
        rng = np.random.default_rng(0)
        quaternions = rng.standard_normal((2, 20, 4))
        quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
        start, end = quaternion_to_matrix(quaternions)
        relative = relative_quaternion(*torch.from_numpy(quaternions))
        np.testing.assert_allclose(
            quaternion_to_matrix(relative.numpy()), end @ np.swapaxes(start, 1, 2), atol=1e-12
        )
        assert (relative[:, 0] >= 0).all()
        vectors = rng.standard_normal((20, 3))
        np.testing.assert_allclose(
            rotate(relative, torch.from_numpy(vectors)).numpy(),
            np.einsum("bij,bkj,bk->bi", end, start, vectors),
            atol=1e-12,
        )

    def test_moves_are_up_to_three_steps_either_way_within_a_rollout(self, small_rollouts):
        moves = RolloutDataset(small_rollouts).moves(400, generator())
        states = small_rollouts.positions
        found = set()
        for before, change in zip(moves.before.numpy(), moves.change.numpy(), strict=True):
            r, i = np.argwhere((states == before).all(axis=(2, 3)))[0]
            distances = np.abs(states[r] - (before + change)).max(axis=(1, 2))
            assert distances.min() < 1e-6
            found.add(int(distances.argmin() - i))
        assert found == {-3, -2, -1, 1, 2, 3}

    def test_the_paper_s_samples_go_forward_or_stay(self, small_rollouts):
        batch = RolloutDataset(small_rollouts, plain=True).sample(200, generator(), Scales())
        still = batch.change.abs().amax(1) == 0
        assert 0.1 < still.float().mean() < 0.4
        assert (batch.actions[still][..., :3] == 0).all()
        assert torch.allclose(batch.actions[still][..., 3], torch.ones(1), atol=1e-6)

    def test_encoding_does_not_depend_on_place_and_heading(self, small_rollouts):
        moves = RolloutDataset(small_rollouts).moves(30, generator())
        turn = torch.from_numpy(exp_so3([0.0, 0.0, 1.3])).float()
        vector = moves.turn[..., 1:] @ turn.T
        moved = Moves(
            moves.before @ turn.T + torch.tensor([1.0, 2.0, 3.0]),
            moves.change @ turn.T,
            moves.shift @ turn.T,
            torch.cat([moves.turn[..., :1], vector], -1),
            *moves[4:],
        )
        for a, b in zip(encode(moves, Scales()), encode(moved, Scales()), strict=True):
            torch.testing.assert_close(a, b, atol=2e-4, rtol=0.0)

    @pytest.mark.parametrize("symmetry", ["mirrored", "exchanged"])
    @pytest.mark.parametrize("bend", [0.0, 2.0])
    def test_a_uniform_rod_has_the_symmetries_that_samples_use(self, symmetry, bend):
        rod, turned = (
            CosseratRod(RodProperties(length=0.5, rest_curvature=(about_d1, 0.0, 0.0)))
            for about_d1 in (bend, -bend if symmetry == "exchanged" else bend)
        )
        boundary = random_boundary(np.random.default_rng(4), 0.5)
        shape = rod.settle(boundary).positions
        assert boundary.right is not None
        if symmetry == "mirrored":  # y -> -y; of the frame, d1 is turned back to be right-handed
            flip = np.diag([1.0, -1.0, 1.0, 1.0])
            other = np.diag([-1.0, 1.0, 1.0, 1.0])
            clamps = [flip @ clamp @ other for clamp in (boundary.left, boundary.right)]
            expected = shape * [1.0, -1.0, 1.0]
        else:  # half a turn about d1 points d3 the other way
            half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
            clamps = [clamp @ half_turn for clamp in (boundary.right, boundary.left)]
            expected = shape[::-1]
        settled = turned.settle(BoundaryPoses(*clamps), start=expected)
        np.testing.assert_allclose(settled.positions, expected, atol=1e-6)

    def test_mirrored_samples_are_those_of_the_mirrored_move(self, small_rollouts):
        moves = RolloutDataset(small_rollouts).moves(10, generator())
        x_axis = heading(moves.before)[:, :, 0]
        across = torch.stack([-x_axis[:, 1], x_axis[:, 0], torch.zeros(10)], 1)
        flip = torch.eye(3) - 2 * across[:, :, None] * across[:, None]
        axial = moves.turn[..., 1:] @ -flip
        mirrored = Moves(
            moves.before @ flip,
            moves.change @ flip,
            moves.shift @ flip,
            torch.cat([moves.turn[..., :1], axial], -1),
            *moves[4:],
        )
        everyone = torch.ones(10, dtype=torch.bool)
        for a, b in zip(encode(moves, Scales())[:3], encode(mirrored, Scales())[:3], strict=True):
            torch.testing.assert_close(_mirror_some(a, everyone), b, atol=1e-4, rtol=0.0)


class TestNetwork:
    def test_sizes_are_the_paper_s(self):
        shapes = [tuple(p.shape) for n, p in DloNetwork(51).named_parameters() if "weight" in n]
        assert shapes == [
            (256, 153), (256, 256), (256, 256), (128, 7), (128, 128),
            (256, 512), (256, 256), (256, 256), (153, 256),
        ]  # fmt: skip

    def test_numpy_agrees_with_torch(self, varied_rollouts):
        torch.manual_seed(0)
        dataset, scales = RolloutDataset(varied_rollouts), Scales()
        network = RelativeNetwork(51)
        with torch.no_grad():
            network.modulation.weight.mul_(10.0)
            network.modulation.bias.normal_(std=0.1)
        network.fit(dataset.sample(300, generator(1), scales))
        layers, conditioning = network.export()
        predictor = ShapePredictor(Weights(layers, scales, {}, conditioning, "silu"))
        moves = dataset.moves(40, generator(2))
        batch = encode(moves, scales)
        with torch.no_grad():
            change = network(batch.state, batch.actions, batch.rods).view(-1, 51, 3)
        change = change * (scales.change * moves.lengths[:, None, None])
        expected = (change @ heading(moves.before).transpose(1, 2)).numpy()
        inner = np.setdiff1d(np.arange(51), CLAMP_NODES % 51)
        for i in range(40):
            rollout = int((dataset.lengths == moves.lengths[i]).nonzero())
            rod = predictor.for_rod(varied_rollouts.properties(rollout))
            turn = log_so3(quaternion_to_matrix(moves.turn[i].numpy()))
            vector = np.concatenate([moves.shift[i].numpy(), turn], axis=1).ravel()
            x = moves.before[i].numpy().astype(float)
            got = rod.predict(x, BoundaryDisplacement.from_vector(vector)) - x
            error = np.abs(got - expected[i])[inner].max() / np.abs(expected[i]).max()
            assert error < 2e-5

    def test_a_null_action_changes_nothing(self):
        network = RelativeNetwork(51)
        state = torch.randn(5, 153, generator=generator())
        rods = torch.rand(5, 4, generator=generator(1))
        with torch.no_grad():
            change = network(state, network.null.expand(5, 2, 7), rods)
        torch.testing.assert_close(change, torch.zeros(5, 153), atol=1e-6, rtol=0.0)


class TestTraining:
    @pytest.mark.parametrize("plain", [False, True])
    def test_learns(self, small_settings, plain):
        one_kind = dataclasses.replace(
            small_settings, n_rollouts=24, length_min=0.5, length_max=0.5
        )
        settings = TrainingSettings(
            steps=150, batch_size=64, hidden=32, learning_rate=1e-2, plain=plain
        )
        trainer = Trainer(simulate_all(one_kind), settings)
        losses = []
        for _ in range(settings.steps):
            trainer.step()
            trainer.validate()
            losses.append(trainer.history[-1][1])
        assert min(losses) < 0.95 * losses[0]
        assert trainer.best_loss == min(losses)

    def test_a_seed_fixes_everything(self, small_rollouts):
        networks = []
        for seed in (0, 0, 1):
            trainer = Trainer(small_rollouts, dataclasses.replace(SHORT, seed=seed))
            for _ in range(4):
                trainer.step()
            networks.append(trainer.network.state_dict()["network.prediction.2.weight"].clone())
        assert torch.equal(networks[0], networks[1])
        assert not torch.equal(networks[0], networks[2])

    def test_the_best_weights_are_kept_not_the_last(self, small_rollouts):
        trainer = Trainer(small_rollouts, SHORT)
        trainer.validate()
        best = {name: value.clone() for name, value in trainer.network.state_dict().items()}
        with torch.no_grad():
            for parameter in trainer.network.parameters():
                parameter.add_(1.0)
        trainer.validate()
        for name, value in trainer.best_network().state_dict().items():
            assert torch.equal(value, best[name])

    @pytest.mark.parametrize("plain", [False, True])
    def test_resuming_after_a_kill_ends_where_an_undisturbed_training_does(
        self, data, tmp_path, monkeypatch, plain
    ):
        settings = dataclasses.replace(SHORT, plain=plain)
        monkeypatch.setattr(module, "CHECKPOINT_EVERY", 5)
        train_surrogate(data, settings, threads=1, out=tmp_path / "whole")

        class Killed(BaseException):
            pass

        step = Trainer.step

        def killed(trainer):
            if trainer.step_count == 8:
                raise Killed
            step(trainer)

        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "step", killed)
            with pytest.raises(Killed):
                train_surrogate(data, settings, threads=1, out=tmp_path / "halves")
        with pytest.raises(FileExistsError, match="--resume"):
            train_surrogate(data, settings, threads=1, out=tmp_path / "halves")
        train_surrogate(data, settings, threads=1, out=tmp_path / "halves", resume=True)
        ends = [
            torch.load(tmp_path / name / "checkpoint.pt", weights_only=True)
            for name in ("whole", "halves")
        ]
        assert ends[0]["history"] == ends[1]["history"]
        for a, b in zip(*(end["network"].values() for end in ends), strict=True):
            assert torch.equal(a, b)

    def test_the_command_leaves_weights_that_say_how_they_were_made(self, data, tmp_path, capsys):
        train_surrogate(data, SHORT, threads=1, out=tmp_path / "out")
        file = tmp_path / "out" / "shape_predictor.safetensors"
        training = load_weights(file).training
        assert training["steps"] == 12
        assert training["rollouts"]["n_rollouts"] == 4
        metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
        assert metrics["data_sha256"] == training["data_sha256"]
        assert ShapePredictor.load(file).n_nodes == 51
        capsys.readouterr()
        train_surrogate(data, threads=1, evaluate=True, weights=file)
        assert "PTP3D" in capsys.readouterr().out

    def test_a_damaged_checkpoint_and_other_settings_are_named(self, small_rollouts, tmp_path):
        trainer = Trainer(small_rollouts, SHORT)
        trainer.save(tmp_path / "checkpoint.pt")
        other = Trainer(small_rollouts, dataclasses.replace(SHORT, noise=0.1))
        with pytest.raises(ValueError, match="noise"):
            other.load(tmp_path / "checkpoint.pt")
        (tmp_path / "checkpoint.pt").write_bytes(b"no such thing")
        with pytest.raises(WeightsError, match=r"checkpoint.pt: damaged"):
            trainer.load(tmp_path / "checkpoint.pt")

    def test_a_checkpoint_of_another_version_or_network_is_named(self, small_rollouts, tmp_path):
        trainer, file = Trainer(small_rollouts, SHORT), tmp_path / "checkpoint.pt"
        torch.save({"settings": dataclasses.asdict(SHORT), "epoch": 3}, file)
        with pytest.raises(
            WeightsError, match="expected a checkpoint of schema dlo-training/1, got None"
        ):
            trainer.load(file)
        trainer.save(file)
        content = torch.load(file, weights_only=True)
        content["network"].popitem()
        torch.save(content, file)
        with pytest.raises(
            WeightsError, match=r"(?s)checkpoint.pt: .*another shape: .*Missing key"
        ):
            trainer.load(file)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"resume": True, "overwrite": True}, "resume, overwrite: expected one of them"),
            ({"weights": Path("w.safetensors")}, "weights: .*--evaluate"),
            ({"evaluate": True, "resume": True}, "evaluate: "),
            ({"threads": 0}, "threads: expected at least 1, got 0"),
        ],
    )
    def test_options_that_do_not_go_together_are_refused(self, data, tmp_path, options, message):
        with pytest.raises(ValueError, match=message):
            train_surrogate(data, SHORT, out=tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()

    def test_resume_needs_a_checkpoint_and_deletes_nothing(self, data, tmp_path):
        kept = tmp_path / "shape_predictor.safetensors"
        kept.write_bytes(b"trained for a week")
        with pytest.raises(FileNotFoundError, match="nothing to resume"):
            train_surrogate(data, SHORT, out=tmp_path, resume=True)
        assert [file.name for file in tmp_path.iterdir()] == [kept.name]

    def test_settings_name_what_is_wrong(self):
        for change, name in (({"steps": 0}, "steps"), ({"learning_rate": 0.0}, "learning_rate")):
            with pytest.raises(ValueError, match=name):
                dataclasses.replace(SHORT, **change)

    def test_one_rollout_is_not_enough(self, small_rollouts):
        with pytest.raises(DatasetError, match="at least 2 rollouts"):
            Trainer(small_rollouts.some(slice(1)), SHORT)

    def test_default_settings_are_the_paper_s(self):
        s, r = TrainingSettings(), RolloutSettings()
        assert (s.steps, s.batch_size, s.learning_rate, s.validation_share) == (
            20_000,
            256,
            5e-4,
            0.1,
        )
        assert (r.n_rollouts, r.n_actions, r.n_steps, r.length_min, r.length_max) == (
            2500, 5, 10, 0.45, 0.6,
        )  # fmt: skip


def test_ctrl_c_saves_a_checkpoint_that_resume_goes_on_from(data, tmp_path, monkeypatch):
    step = Trainer.step

    def interrupted(self):
        step(self)
        if self.step_count == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Trainer, "step", interrupted)
    with pytest.raises(KeyboardInterrupt, match="resume goes on at step 3"):
        train_surrogate(data, SHORT, out=tmp_path / "halves", threads=1)
    monkeypatch.setattr(Trainer, "step", step)
    train_surrogate(data, SHORT, out=tmp_path / "halves", threads=1, resume=True)
    train_surrogate(data, SHORT, out=tmp_path / "whole", threads=1)
    whole, halves = (
        load_weights(tmp_path / name / "shape_predictor.safetensors").layers.prediction
        for name in ("whole", "halves")
    )
    for one, other in zip(whole, halves, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
