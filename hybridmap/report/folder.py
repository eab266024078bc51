"""Folders that hold one page and what belongs to it: what may be written there, and what must not be lost."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from hybridmap.errors import StoreError

_MARK = '<meta name="generator" content="hybridmap '  # the head of every page of ours has it, before the version


def prepare_folder(folder: Path, kind: str, files: Sequence[str], *, overwrite: bool = False) -> None:
    """Check that a page may be written into a folder, before anything is run; leaves nothing.

    Args:
        folder: where to.
        kind: what the folder is to hold, such as `comparison`.
        files: the names of its files, the page first. Without a page of ours the others are somebody else's.
        overwrite: whether files of ours may be replaced.

    Raises:
        StoreError: it is a file, holds something else, or holds one of that kind and `overwrite` is not given,
            or it cannot be written to.
    """
    if not folder.exists():
        _try_to_write(folder)
        return
    if not folder.is_dir():
        raise StoreError(f"{folder}: is a file; expected a folder that is empty or does not exist")
    found = sorted(entry.name for entry in folder.iterdir())
    ours = files if _is_ours(folder / files[0]) else ()
    other = [name for name in found if name not in ours]
    if other:
        raise StoreError(f"{folder}: not empty and no {kind} (it holds {other[0]!r}); choose another folder")
    if found and not overwrite:
        raise StoreError(f"{folder}: holds a {kind} already; choose another folder or give --overwrite")
    _try_to_write(folder)


def _is_ours(page: Path) -> bool:
    return page.is_file() and _MARK in page.read_text(encoding="utf-8", errors="replace")


def _try_to_write(folder: Path) -> None:
    """Make a folder beside what will be written, and take it away again."""
    beside = next((place for place in (folder, *folder.absolute().parents) if place.exists()), Path())
    try:
        Path(tempfile.mkdtemp(prefix=".hybridmap-", dir=beside)).rmdir()
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written to: {error.strerror}") from None
