"""Output folders: refused, replaced, and never somebody else's."""

import os

import pytest

from dlo_gym.output_folder import check_output_folder, check_resume, replace_folder

MADE = ("metrics.json", "checkpoint-*")


def test_a_new_folder_is_fine(tmp_path):
    check_output_folder(tmp_path / "new", MADE, overwrite=False)


def test_an_existing_folder_is_refused_unless_it_may_be_replaced(tmp_path):
    (tmp_path / "metrics.json").touch()
    (tmp_path / "checkpoint-1").mkdir()
    with pytest.raises(FileExistsError, match="pass --overwrite"):
        check_output_folder(tmp_path, MADE, overwrite=False)
    check_output_folder(tmp_path, MADE, overwrite=True)


def test_what_the_command_did_not_make_is_named(tmp_path):
    for name in ("metrics.json", "thesis.tex"):
        (tmp_path / name).touch()
    with pytest.raises(FileExistsError, match=r"holds thesis\.tex, which"):
        check_output_folder(tmp_path, MADE, overwrite=True)


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="is a file"):
        check_output_folder(tmp_path / "file", MADE, overwrite=True)


def make(folder, content):
    folder.mkdir()
    (folder / "metrics.json").write_text(content)
    return folder


def test_replacing_leaves_the_new_one_only(tmp_path):
    make(tmp_path / "out", "old")
    replace_folder(make(tmp_path / "part", "new"), tmp_path / "out")
    assert (tmp_path / "out" / "metrics.json").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_replacement_that_fails_gives_the_old_one_back(tmp_path, monkeypatch):
    out, part = make(tmp_path / "out", "old"), make(tmp_path / "part", "new")
    replace = os.replace

    def interrupted(source, target):
        if source == part:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        replace_folder(part, out)
    assert (out / "metrics.json").read_text() == "old"


def test_going_on_and_replacing_exclude_each_other():
    for resume, overwrite in ((False, False), (True, False), (False, True)):
        check_resume(resume=resume, overwrite=overwrite)
    with pytest.raises(ValueError, match="resume, overwrite: expected one of them at most"):
        check_resume(resume=True, overwrite=True)
