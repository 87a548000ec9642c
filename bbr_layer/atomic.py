"""Files read or written whole or not at all, with one clear sentence where that cannot be done."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Random bytes in a temporary name: two runs writing the same file at once do not meet.
NAME_BYTES = 4


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` when the block ends well, and vanishes when it does not.

    The temporary file lies in the same folder (a rename is atomic only within one file system) and has the
    same suffix, since many libraries choose the format by it.

    Raises
    ------
    OSError: as ``writable_path``.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_write(Path(folder) / "note.txt") as temporary:
    ...         _ = temporary.write_text("whole")
    ...     (Path(folder) / "note.txt").read_text()
    'whole'
    """
    final = writable_path(path)
    temporary = final.with_name(f".{final.stem}.{secrets.token_hex(NAME_BYTES)}{final.suffix}")
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        raise type(error)(f"{path} cannot be written ({error.strerror}): choose another folder") from error
    try:
        yield temporary
        temporary.replace(final)
    finally:
        temporary.unlink(missing_ok=True)


def writable_path(path: str | Path) -> Path:
    """Where ``path`` really lies, if a file can be written there; for asking before a long computation.

    Raises
    ------
    FileNotFoundError: the folder does not exist.
    OSError: the folder may not be written (``PermissionError``), or ``path`` is a folder or a device.
    """
    final = Path(path).resolve()  # a link keeps pointing at its file
    if not final.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: {final.parent} is not a folder; create it first")
    if final.exists() and not final.is_file():
        raise OSError(f"{path} cannot be written: it is a folder or a device; give the name of a file")
    if not os.access(final.parent, os.W_OK):
        raise PermissionError(f"{path} cannot be written: {final.parent} is locked; choose another folder")
    return final


def existing_file(path: str | Path) -> Path:
    """``path``, if it is a file.

    Raises
    ------
    FileNotFoundError: nothing is there.
    ValueError: a folder is there.
    """
    found = Path(path)
    if not found.exists():
        raise FileNotFoundError(f"{path} does not exist: check the name, and the folder it is seen from")
    if found.is_dir():
        raise ValueError(f"{path} is a folder; a file is wanted: name one of the files in it")
    return found
