"""Files that appear whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dlo_gym.exceptions import DloError


@contextmanager
def written_aside(file: Path, error: type[DloError]) -> Iterator[Path]:
    """A temporary file to write, which takes the name ``file`` when the block ends well.

    Raises:
        error: if it cannot be written, for example on a full disk; nothing is left behind, and
            what ``file`` held before it still holds.
    """
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        yield part
        with part.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(part, file)
    except OSError as cause:
        raise error(f"{file}: could not be written: {cause.strerror or cause}") from cause
    finally:
        part.unlink(missing_ok=True)
