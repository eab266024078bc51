"""Who is writing a session folder: the kernel knows, and forgets it when a process dies."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from contextlib import ExitStack
from pathlib import Path

from hybridmap.errors import StoreError

_TAKEN = (errno.EWOULDBLOCK, errno.EACCES)
_TRIES, _PAUSE_S = 10, 0.02


def hold(folder: Path) -> ExitStack:
    """Hold a folder against other runs that would write a session there, until the result is closed; leaves nothing in it.

    Tries for 0.2 s: `is_being_written` takes a lock too, for an instant, and is no run.
    A file system without locks holds nobody off.

    Raises:
        StoreError: another run holds it.
        OSError: it cannot be read.
    """
    with ExitStack() as stack:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        stack.callback(os.close, handle)
        if not _take_soon(handle):
            raise StoreError(f"{folder}: is being written by another run; wait for it or choose another folder")
        return stack.pop_all()


def is_being_written(folder: Path) -> bool:
    """Whether a run writes a session there now."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        return not _take(handle, fcntl.LOCK_SH)
    finally:
        os.close(handle)


def _take_soon(handle: int) -> bool:
    for _ in range(_TRIES):
        if _take(handle, fcntl.LOCK_EX):
            return True
        time.sleep(_PAUSE_S)
    return False


def _take(handle: int, how: int) -> bool:
    try:
        fcntl.flock(handle, how | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _TAKEN
    return True
