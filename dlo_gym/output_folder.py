"""Output folders of the commands: what a user has is never deleted unasked."""

import os
import shutil
from collections.abc import Iterable
from fnmatch import fnmatch
from pathlib import Path


def check_resume(*, resume: bool, overwrite: bool) -> None:
    """Refuse to go on with a former result and to replace it, both at once.

    Raises:
        ValueError: if both are asked for.
    """
    if resume and overwrite:
        raise ValueError(
            "resume, overwrite: expected one of them at most, got both; --resume goes on with the"
            " former result, --overwrite replaces it"
        )


def check_output_folder(out: Path, made: Iterable[str], *, overwrite: bool) -> None:
    """Refuse an output folder that exists, unless it is a former result and may be replaced.

    Args:
        out: the folder that a command is about to make.
        made: names, or patterns as ``fnmatch`` takes them, of what the command leaves in it.
        overwrite: whether a former result may be replaced.

    Raises:
        FileExistsError: if ``out`` exists and ``overwrite`` is false, or it holds anything that the
            command did not make.
    """
    if not out.exists():
        return
    if not out.is_dir():
        raise FileExistsError(f"{out} is a file; name a folder")
    patterns = tuple(made)
    names = sorted(entry.name for entry in out.iterdir())
    foreign = [name for name in names if not any(fnmatch(name, pattern) for pattern in patterns)]
    if foreign:
        more = f" and {len(foreign) - 3} more" if len(foreign) > 3 else ""
        raise FileExistsError(
            f"{out} exists and holds {', '.join(foreign[:3])}{more}, which this command did not"
            " make; name another folder (--overwrite replaces former results only)"
        )
    if not overwrite:
        raise FileExistsError(f"{out} exists; pass --overwrite to replace it")


def replace_folder(finished: Path, out: Path) -> None:
    """Give the folder ``finished`` the name ``out``; a former ``out`` goes when that has worked."""
    former = out.with_name(f".{out.name}.former-{os.getpid()}")
    if out.exists():
        os.replace(out, former)
    try:
        os.replace(finished, out)
    except BaseException:
        if former.exists():
            os.replace(former, out)
        raise
    shutil.rmtree(former, ignore_errors=True)
