"""The `dlo` command: help, unknown names, errors without tracebacks."""

import pytest

from dlo_gym import cli


def test_every_command_explains_itself(capsys):
    for name in cli.COMMANDS:
        with pytest.raises(SystemExit) as end:
            cli.main([*name.split(), "--help"])
        assert end.value.code == 0
        text = capsys.readouterr().out
        assert f"dlo {name}" in text


def test_listing_names_every_command(capsys):
    assert cli.main([]) == 0
    listing = capsys.readouterr().out
    assert all(name in listing for name in cli.COMMANDS)


def test_unknown_command_lists_the_known_ones(capsys):
    assert cli.main(["trakc"]) == 2
    assert "track" in capsys.readouterr().err


def test_a_users_mistake_is_one_message_without_a_traceback(capsys, tmp_path):
    assert cli.main(["track", str(tmp_path / "nothing")]) == 1
    message = capsys.readouterr().err
    assert "nothing" in message
    assert "Traceback" not in message


def test_existing_output_is_refused(capsys, tmp_path):
    (tmp_path / "kept.txt").write_text("mine")
    for name in ("demo", "control"):
        assert cli.main([name, "--out", str(tmp_path)]) == 1
        assert "--overwrite" in capsys.readouterr().err
    assert (tmp_path / "kept.txt").read_text() == "mine"


def test_a_failing_disk_is_one_message_without_a_traceback(capsys, tmp_path):
    (tmp_path / "file").touch()
    assert cli.main(["demo", "--out", str(tmp_path / "file" / "out")]) == 1
    message = capsys.readouterr().err
    assert "file" in message
    assert "Traceback" not in message


def test_an_interruption_says_what_is_kept(capsys, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt("2 of 3 are kept")

    monkeypatch.setattr("control.demo.demo", interrupted)
    assert cli.main(["demo"]) == 130
    assert "interrupted; 2 of 3 are kept" in capsys.readouterr().err
