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

from dlo_gym.exceptions import DatasetError
from dlo_gym.surrogate.rollouts import Manifest, load_rollouts, rollouts, shard_name
from dlo_gym.surrogate.simulation import RolloutSettings, simulate_rollout

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


class TestDataset:
    def test_what_is_loaded_is_what_was_simulated(self, finished):
        loaded, manifest = load_rollouts(finished)
        assert manifest.settings == TINY
        for i in range(TINY.n_rollouts):
            made = simulate_rollout(TINY, i)
            for got, expected in zip(loaded, made, strict=True):
                np.testing.assert_array_equal(got[i], expected[0])

    @pytest.mark.slow
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

    def test_going_on_and_overwriting_at_once_deletes_nothing(self, finished):
        with pytest.raises(ValueError, match="resume, overwrite"):
            rollouts(finished, TINY, workers=1, resume=True, overwrite=True)
        assert len(load_rollouts(finished)[0].lengths) == TINY.n_rollouts

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
        (tmp_path / "manifest.json").write_text('{"schema": "dlo-rollouts/2", "settings"')
        with pytest.raises(DatasetError, match="manifest.json: damaged"):
            load_rollouts(tmp_path)
        (tmp_path / "manifest.json").write_text(json.dumps({"schema": "dlo-rollouts/1"}))
        with pytest.raises(DatasetError, match=r"got dlo-rollouts/1; make the data again"):
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
        settings = dataclasses.replace(TINY, n_rollouts=160, n_steps=10)
        name, value = "DLO_TEST_MARK", str(uuid.uuid4())
        mark = f"{name}={value}"
        arguments = ["rollouts", str(folder), "--workers", "2"]
        for field, setting in dataclasses.asdict(settings).items():
            arguments += [f"--{field.replace('_', '-')}", str(setting)]
        command = f"from dlo_gym.cli import main; main({arguments!r})"
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
        for i in (0, 5, 159):
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
