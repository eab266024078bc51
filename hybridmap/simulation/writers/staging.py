"""Write beside, move at the end: a failure leaves nothing behind, and nothing of somebody else's is replaced."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hybridmap.errors import StreamError

Progress = Callable[[int, int | None], None]
"""Called with the observations written so far and their number."""

_SIGNS_OF_OURS = ("metadata.yaml", "associations.txt")


def silent(done: int, total: int | None) -> None:
    """The progress of somebody who does not watch."""


@contextmanager
def staged(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a path of the same name in a folder beside `path`; it takes its place when the block ends without an error.

    Raises:
        StreamError: something is there already that may not be replaced, or the place cannot be written to.
    """
    _check(path, overwrite=overwrite)
    scratch = path.with_name(f".{path.name}.partial")
    new_folders = [parent for parent in path.parents if not parent.exists()]
    try:
        _remove(scratch)
        scratch.mkdir(parents=True)
        yield scratch / path.name
        _remove(path)
        (scratch / path.name).rename(path)
    except OSError as error:
        raise StreamError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        _remove(scratch)
        for folder in new_folders:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def _check(path: Path, *, overwrite: bool) -> None:
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not overwrite:
        raise StreamError(f"{path}: exists already; choose another place or give --overwrite")
    if path.is_dir() and not any((path / sign).is_file() for sign in _SIGNS_OF_OURS):
        raise StreamError(f"{path}: a folder that is no recording; --overwrite replaces recordings only")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    elif path.exists():
        path.unlink()
