import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from dlo_gym.exceptions import DatasetError, RodDiverged
from dlo_gym.geometry.se3 import quaternion_to_matrix
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.surrogate import rollouts as module
from dlo_gym.surrogate.evaluation import boundary
from dlo_gym.surrogate.rollouts import (
    Manifest,
    RolloutSettings,
    load_rollouts,
    plausible,
    rollouts,
    shard_name,
    simulate_rollout,
)

TINY = RolloutSettings(n_rollouts=6, seed=1, n_actions=1, n_steps=2, n_elements=8, shard_size=2)


class Killed(BaseException):
    """What no handler may swallow."""


def hashes(folder: Path) -> dict[str, str]:
    return Manifest.read(folder).shards


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "data"
    rollouts(folder, TINY, workers=1)
    return folder


class TestRecipe:
    def test_states_are_equilibria_of_the_recorded_clamps(self, small_rollouts, small_settings):
        for i in range(3):
            positions = small_rollouts.positions[i].astype(float)
            rod = CosseratRod(small_settings.properties(float(small_rollouts.lengths[i])), 50)
            for state in (0, 4, 10):
                held = boundary(positions[state], small_rollouts.clamps[i, state])
                settled = rod.settle(held, start=positions[state])
                np.testing.assert_allclose(settled.positions, positions[state], atol=2e-6)

    def test_moves_stay_within_the_action_and_do_not_turn_the_rod_about_its_axis(
        self, small_rollouts, small_settings
    ):
        s = small_settings
        for positions, clamps in zip(small_rollouts.positions, small_rollouts.clamps, strict=True):
            held = [boundary(x, c) for x, c in zip(positions.astype(float), clamps, strict=True)]
            for before, after in zip(held[:-1], held[1:], strict=True):
                twists = before.displacement_to(after).vector.reshape(2, 2, 3)
                assert np.abs(twists[:, 0]).max() <= s.translation / s.n_steps + 1e-6
                assert np.linalg.norm(twists[:, 1], axis=1).max() <= (
                    np.sqrt(2) * s.rotation / s.n_steps + 1e-5
                )
                for clamp, twist in zip((before.left, before.right), twists, strict=True):
                    assert abs(clamp[:3, 2] @ twist[1]) < 1e-5

    def test_an_action_is_divided_into_equal_steps(self, small_rollouts):
        ends = small_rollouts.positions[:, :, [0, -1]].astype(float)
        steps = np.diff(ends, axis=1).reshape(6, 2, 5, 2, 3)
        np.testing.assert_allclose(steps, np.broadcast_to(steps[:, :, :1], steps.shape), atol=1e-6)

    def test_lengths_and_clamp_distances_lie_in_their_ranges(self, small_rollouts):
        lengths = small_rollouts.lengths
        assert ((lengths >= 0.45) & (lengths <= 0.6)).all()
        chord = small_rollouts.positions[:, :, -1] - small_rollouts.positions[:, :, 0]
        ratio = np.linalg.norm(chord, axis=-1) / lengths[:, None]
        assert ratio.min() > 0.2
        assert ratio.max() < 0.99

    def test_clamps_hold_the_first_and_last_element(self, small_rollouts):
        x = small_rollouts.positions.astype(float)
        elements = np.stack([x[:, :, 1] - x[:, :, 0], x[:, :, -1] - x[:, :, -2]], axis=2)
        elements /= np.linalg.norm(elements, axis=-1, keepdims=True)
        d3 = quaternion_to_matrix(small_rollouts.clamps)[..., 2]
        assert (elements * d3).sum(-1).min() > np.cos(0.05)

    def test_a_rollout_depends_on_its_seed_and_index_alone(self):
        again = simulate_rollout(TINY, 4)
        np.testing.assert_array_equal(simulate_rollout(TINY, 4).positions, again.positions)
        other_seed = simulate_rollout(dataclasses.replace(TINY, seed=2), 4)
        assert np.abs(other_seed.positions - again.positions).max() > 1e-3
        assert np.abs(simulate_rollout(TINY, 5).positions - again.positions).max() > 1e-3

    def test_an_action_that_the_rod_cannot_follow_is_drawn_again(self, monkeypatch):
        moves = []

        class Fragile(CosseratRod):
            def move(self, displacement):
                moves.append(displacement)
                if len(moves) == 4:
                    raise RodDiverged("lost")
                return super().move(displacement)

        settings = dataclasses.replace(TINY, n_actions=1, n_steps=5)
        undisturbed = simulate_rollout(settings, 0)
        monkeypatch.setattr(module, "CosseratRod", Fragile)
        made = simulate_rollout(settings, 0)
        assert len(moves) == 9
        np.testing.assert_array_equal(made.positions[0, 0], undisturbed.positions[0, 0])
        ends = np.diff(made.positions[0][:, [0, -1]].astype(float), axis=0)
        np.testing.assert_allclose(ends, np.broadcast_to(ends[:1], ends.shape), atol=1e-6)

    def test_a_rod_that_always_diverges_ends_in_an_error(self, monkeypatch):
        class Broken(CosseratRod):
            def settle(self, boundary, start=None):
                raise RodDiverged("lost")

        monkeypatch.setattr(module, "CosseratRod", Broken)
        with pytest.raises(DatasetError, match="rollout 3"):
            simulate_rollout(TINY, 3)

    @pytest.mark.parametrize(
        ("change", "name"),
        [
            ({"n_rollouts": 0}, "n_rollouts"),
            ({"seed": -1}, "seed"),
            ({"n_elements": 2}, "n_elements"),
            ({"length_min": 0.7}, "length_min"),
            ({"translation": -0.1}, "translation"),
            ({"radius": 0.0}, "radius"),
        ],
    )
    def test_settings_name_what_is_wrong(self, change, name):
        with pytest.raises(ValueError, match=name):
            dataclasses.replace(TINY, **change)

    def test_plausible_refuses_taut_touching_steep_and_folded(self, small_rollouts):
        held = boundary(small_rollouts.positions[0, 0].astype(float), small_rollouts.clamps[0, 0])
        along = (held.right[:3, 3] - held.left[:3, 3]) / held.distance
        assert plausible(held, 1.5 * held.distance)
        assert not plausible(held, 1.01 * held.distance)
        assert not plausible(held, 6.0 * held.distance)
        steep = dataclasses.replace(held, right=held.right.copy())
        steep.right[:3, 3] = held.left[:3, 3] + [0.01, 0.0, held.distance]
        assert not plausible(steep, 1.5 * held.distance)
        folded = dataclasses.replace(held, left=held.left.copy())
        folded.left[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ folded.left[:3, :3]
        folded.left[:3, 2] = -along
        assert not plausible(folded, 1.5 * held.distance)


class TestDataset:
    def test_what_is_loaded_is_what_was_simulated(self, finished):
        loaded, manifest = load_rollouts(finished)
        assert manifest.settings == TINY
        for i in range(TINY.n_rollouts):
            made = simulate_rollout(TINY, i)
            for got, expected in zip(loaded, made, strict=True):
                np.testing.assert_array_equal(got[i], expected[0])

    def test_workers_do_not_matter(self, finished, tmp_path):
        rollouts(tmp_path / "data", TINY, workers=2)
        assert hashes(tmp_path / "data") == hashes(finished)

    def test_shard_size_does_not_matter(self, finished, tmp_path):
        rollouts(tmp_path / "data", dataclasses.replace(TINY, shard_size=4), workers=1)
        for a, b in zip(
            load_rollouts(finished)[0], load_rollouts(tmp_path / "data")[0], strict=True
        ):
            np.testing.assert_array_equal(a, b)

    def test_refuses_a_folder_that_exists(self, finished):
        with pytest.raises(FileExistsError, match="--overwrite"):
            rollouts(finished, TINY, workers=1)

    def test_overwrite_makes_it_anew(self, tmp_path):
        rollouts(tmp_path / "data", TINY, workers=1)
        other = dataclasses.replace(TINY, n_rollouts=2)
        rollouts(tmp_path / "data", other, workers=1, overwrite=True)
        assert len(load_rollouts(tmp_path / "data")[0].lengths) == 2

    def test_overwrite_spares_a_folder_of_other_things(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("years of work")
        with pytest.raises(FileExistsError, match="other files"):
            rollouts(tmp_path, TINY, workers=1, overwrite=True)
        assert (tmp_path / "thesis.tex").read_text() == "years of work"

    def test_resume_with_other_settings_names_the_setting(self, finished):
        with pytest.raises(ValueError, match="seed"):
            rollouts(finished, dataclasses.replace(TINY, seed=9), workers=1, resume=True)

    def test_a_damaged_shard_is_named_and_made_again(self, finished, tmp_path, capsys):
        folder = tmp_path / "data"
        rollouts(folder, TINY, workers=1)
        shard = folder / shard_name(1)
        content = bytearray(shard.read_bytes())
        content[len(content) // 2] ^= 0xFF
        shard.write_bytes(content)
        with pytest.raises(DatasetError, match="shard_0001.npz"):
            load_rollouts(folder)
        rollouts(folder, TINY, workers=1, resume=True)
        assert "shard_0001.npz" in capsys.readouterr().err
        load_rollouts(folder)
        assert hashes(folder) == hashes(finished)

    def test_a_missing_shard_is_named(self, tmp_path):
        rollouts(tmp_path / "data", TINY, workers=1)
        (tmp_path / "data" / shard_name(2)).unlink()
        with pytest.raises(DatasetError, match="shard_0002.npz"):
            load_rollouts(tmp_path / "data")

    def test_a_folder_without_manifest_and_a_bad_manifest_are_named(self, tmp_path):
        with pytest.raises(DatasetError, match="no manifest.json"):
            load_rollouts(tmp_path)
        (tmp_path / "manifest.json").write_text('{"schema": "dlo-rollouts/1", "settings"')
        with pytest.raises(DatasetError, match="manifest.json: damaged"):
            load_rollouts(tmp_path)
        (tmp_path / "manifest.json").write_text(json.dumps({"schema": "dlo-rollouts/7"}))
        with pytest.raises(DatasetError, match="got dlo-rollouts/7"):
            load_rollouts(tmp_path)

    def test_a_full_disk_is_reported_and_leaves_nothing_half_written(
        self, finished, tmp_path, monkeypatch
    ):
        folder = tmp_path / "data"
        savez, written = np.savez, []

        def full_after_one(file, **arrays):
            if written:
                file.write(b"half a shard")
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            written.append(file)
            savez(file, **arrays)

        monkeypatch.setattr(np, "savez", full_after_one)
        with pytest.raises(DatasetError, match=r"shard_0001.npz.*No space left"):
            rollouts(folder, TINY, workers=1)
        assert sorted(f.name for f in folder.iterdir()) == ["manifest.json", "shard_0000.npz"]
        monkeypatch.undo()
        rollouts(folder, TINY, workers=1, resume=True)
        assert hashes(folder) == hashes(finished)


class TestKilled:
    @pytest.mark.parametrize("at", range(7))
    def test_resumes_wherever_it_was_stopped(self, at, finished, tmp_path, monkeypatch):
        folder, replace, calls = tmp_path / "data", os.replace, []

        def killed(source, target):
            calls.append(target)
            if len(calls) > at:
                raise Killed
            replace(source, target)

        monkeypatch.setattr(os, "replace", killed)
        with pytest.raises(Killed):
            rollouts(folder, TINY, workers=1)
        monkeypatch.undo()
        rollouts(folder, TINY, workers=1, resume=True)
        load_rollouts(folder)
        assert hashes(folder) == hashes(finished)

    def test_kill_minus_nine_leaves_no_process_and_can_be_resumed(self, tmp_path):
        folder = tmp_path / "data"
        settings = dataclasses.replace(TINY, n_rollouts=400, n_steps=10)
        mark = f"DLO_TEST_MARK={uuid.uuid4()}"
        name, value = mark.split("=")
        command = (
            "from dlo_gym.cli import main; main(['rollouts', {folder!r}, '--n-rollouts', '400',"
            " '--seed', '1', '--n-actions', '1', '--n-steps', '10', '--n-elements', '8',"
            " '--shard-size', '2', '--workers', '2'])"
        ).format(folder=str(folder))
        process = subprocess.Popen(
            [sys.executable, "-c", command],
            env={**os.environ, name: value},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and len(list(folder.glob("shard_*.npz"))) < 3:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
        while time.monotonic() < deadline and _processes_with(mark):
            time.sleep(0.05)
        assert not _processes_with(mark)
        assert 0 < len(list(folder.glob("shard_*.npz"))) < settings.n_shards
        rollouts(folder, settings, workers=1, resume=True)
        loaded, _ = load_rollouts(folder)
        assert not list(folder.glob("*.part"))
        for i in (0, 5, 399):
            np.testing.assert_array_equal(
                loaded.positions[i], simulate_rollout(settings, i).positions[0]
            )


def _processes_with(mark: str) -> list[str]:
    """Ids of the processes that were started with ``mark`` in their environment."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (entry / "environ").read_bytes():
                found.append(entry.name)
        except OSError:
            continue
    return found
