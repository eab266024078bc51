"""Output files and folders: locked against other runs, replaced completely or not at all, and repaired after a kill.

`held` gives a folder that is written in place, such as a session. `staged` gives a folder next to the target of an output
that is written at once, such as a recording or an export. A `Kind` describes what differs between outputs.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from hybridmap.errors import OutputError

PREVIOUS = ".previous"
"""The output that is being replaced lies whole in this folder of the held one."""

_MOVING = ".previous.partial"  # on the way to `PREVIOUS` or back: a kill may leave part of an output here
_DROPPED = ".dropped.partial"  # replaced for good: a kill may leave part of it here
_TAKEN = (errno.EWOULDBLOCK, errno.EACCES)
_TRIES, _PAUSE_S = 10, 0.02  # `is_held` takes a lock too, for an instant


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of output folder.

    Attributes:
        name: name of the kind in messages.
        files: names of its files and folders; nothing else in the folder is ever changed.
        is_ours: whether a folder holds an output of this kind.
        continued: whether a new run continues an existing output, without `--overwrite`.
        useful_unfinished: whether the output of a run interrupted by Ctrl-C is kept, if it replaced no earlier one.
    """

    name: str
    files: tuple[str, ...]
    is_ours: Callable[[Path], bool]
    continued: bool = False
    useful_unfinished: bool = False


@dataclass(slots=True)
class Unfinished:
    """The output that is being written, as given by `Held.replaced`.

    Attributes:
        worth_keeping: on an error it stays, with the old one whole in `PREVIOUS`, as after a kill. Ctrl-C does not ask for it.
    """

    worth_keeping: bool = False


@dataclass(frozen=True, slots=True)
class Held:
    """A locked folder, as given by `held`."""

    path: Path
    kind: Kind

    @contextmanager
    def replaced(self) -> Iterator[Unfinished]:
        """Context in which a new output is written while the old one is moved aside.

        On an error the old output is restored, unless the new one is worth keeping; else it is deleted at the end.
        """
        with _named(self.path):
            self._set_aside()
        unfinished = Unfinished()
        try:
            yield unfinished
        except BaseException as error:
            if not self._stays(unfinished, error):
                self._restore()
            raise
        self._drop_previous()

    @contextmanager
    def resumed(self) -> Iterator[Unfinished]:
        """Context in which an unfinished output is gone on with. It stays on any error; an old one is deleted at the end."""
        yield Unfinished(worth_keeping=True)
        self._drop_previous()

    def _stays(self, unfinished: Unfinished, error: BaseException) -> bool:
        if isinstance(error, KeyboardInterrupt):
            return self.kind.useful_unfinished and not (self.path / PREVIOUS).is_dir()
        return unfinished.worth_keeping

    def _drop_previous(self) -> None:
        if (self.path / PREVIOUS).is_dir():
            (self.path / PREVIOUS).rename(self.path / _DROPPED)  # from here on a kill does not bring it back
            shutil.rmtree(self.path / _DROPPED, ignore_errors=True)

    def _admit(self, *, overwrite: bool, resume: bool) -> None:
        """Repair what a killed run left, and refuse a folder that must not be written to."""
        previous = self.path / PREVIOUS
        _refuse_strangers(self.path, self.kind, previous, self.path / _MOVING)
        self._move_back()
        shutil.rmtree(self.path / _DROPPED, ignore_errors=True)
        if not (self.kind.continued or resume):
            _refuse_own(self.path, self.kind, overwrite=overwrite)
        if overwrite and self.kind.is_ours(previous):
            self._restore()  # of the two, the one set aside is known to be whole
        for entry in map(self.path.joinpath, self.kind.files):
            for partial in (_partial(entry), *entry.rglob(".*.partial")):
                if partial.is_file():
                    partial.unlink()
        if not os.access(self.path, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    def _set_aside(self) -> None:
        ours = [entry for entry in map(self.path.joinpath, self.kind.files) if entry.exists()]
        moving = self.path / _MOVING
        try:
            if ours:
                moving.mkdir()
                for entry in ours:
                    entry.rename(moving / entry.name)
                moving.rename(self.path / PREVIOUS)
        except BaseException:
            self._move_back()
            raise

    def _move_back(self) -> None:
        moving = self.path / _MOVING
        if moving.is_dir():
            for entry in sorted(moving.iterdir()):
                entry.rename(self.path / entry.name)
            moving.rmdir()

    def _restore(self) -> None:
        """Delete the new output and restore the old one, if there is one."""
        for name in self.kind.files:
            _remove(self.path / name)
        if (self.path / PREVIOUS).is_dir():
            (self.path / PREVIOUS).rename(self.path / _MOVING)
            self._move_back()


@contextmanager
def held(folder: Path, kind: Kind, *, overwrite: bool = False, resume: bool = False) -> Iterator[Held]:
    """Context in which a folder for an output of this kind is made if needed, and locked against other runs.

    It gives the folder as `Held`; what a killed run left in it is repaired first. If the folder was made, and is empty at the
    end, it is removed with the parents made for it.

    Args:
        folder: the folder.
        kind: what may be in it.
        overwrite: whether it may hold an output already. That stays until `Held.replaced` replaces it.
        resume: whether it may hold an unfinished output, for `Held.resumed`.

    Raises:
        OutputError: the folder is a file, holds something else, holds an output of this kind without `overwrite`, is in use by
            another run, or is not writable.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; expected a folder that is empty or does not exist")
    place = Held(folder, kind)
    with ExitStack() as stack:
        with _named(folder):
            stack.enter_context(_locked(folder, folder))
            place._admit(overwrite=overwrite, resume=resume)
        yield place


@contextmanager
def staged(*targets: Path, kind: Kind | None = None, overwrite: bool = False) -> Iterator[Path]:
    """Context that gives a new folder next to the targets. Files written there replace the targets of the same name at the end.

    An error leaves everything as it was.

    Args:
        targets: files in one folder; with a `kind`, one file or folder of that kind, which is replaced completely.
        kind: kind of the target folder.
        overwrite: whether existing targets may be replaced.

    Raises:
        OutputError: a target exists and may not be replaced, is in use by another run, or cannot be written.
    """
    with _named(targets[0]), ExitStack() as stack:
        _refuse(targets, kind, overwrite=overwrite)
        work = targets[0].absolute()
        work = work.with_name(f".{work.name}.new")
        stack.enter_context(_locked(work, targets[0]))
        _clear(work, targets[0])
        stack.callback(_put_away, work, targets[0])
        _refuse(targets, kind, overwrite=overwrite)
        yield work
        for target in reversed(targets):
            _take_place(work / target.name, target)


def is_held(folder: Path) -> bool:
    """Whether a run, of this process or another, has a folder locked by `held` now. The folder must exist."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        return not _take(handle, fcntl.LOCK_SH)
    finally:
        os.close(handle)


def holds_only(folder: Path, names: tuple[str, ...]) -> bool:
    """Whether a folder holds at least one of `names` and nothing else, apart from this module's hidden files."""
    found = _entries(folder) - {PREVIOUS, _MOVING, _DROPPED}
    return bool(found) and found <= set(names)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8 atomically: a reader or a crash never sees a partial file.

    The file's folder is made if needed, and a file that exists is replaced. Bytes of file names that are not UTF-8 are written
    as escapes.

    Raises:
        OutputError: the file cannot be written.
    """
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a binary file atomically: a reader or a crash never sees a partial file.

    The file's folder is made if needed, and a file that exists is replaced.

    Raises:
        OutputError: the file cannot be written.
    """
    partial = _partial(path)
    with _named(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial")


def _entries(folder: Path) -> set[str]:
    """The entries of a folder, without partial files; empty if there is no folder."""
    entries = folder.iterdir() if folder.is_dir() else ()
    return {entry.name for entry in entries if entry.is_dir() or not (entry.name[0] == "." and entry.suffix == ".partial")}


def _refuse(targets: tuple[Path, ...], kind: Kind | None, *, overwrite: bool) -> None:
    for target in targets:
        if target.is_dir() and kind is None:
            raise OutputError(f"{target}: is a folder; name a file")
        if target.is_dir() and kind is not None:
            _refuse_strangers(target, kind)
            _refuse_own(target, kind, overwrite=overwrite)
        elif target.exists() and not overwrite:
            raise OutputError(f"{target}: exists already; choose another name or give --overwrite")


def _refuse_strangers(folder: Path, kind: Kind, *hidden: Path) -> None:
    found = sorted(_entries(folder))
    if found and not any(map(kind.is_ours, (folder, *hidden))):
        other = next((name for name in found if name not in kind.files), found[0])
        raise OutputError(f"{folder}: not empty and no {kind.name} (it holds {other!r}); choose another folder")


def _refuse_own(folder: Path, kind: Kind, *, overwrite: bool) -> None:
    if not overwrite and _entries(folder):
        raise OutputError(f"{folder}: holds a {kind.name} already; choose another folder or give --overwrite")


def _clear(work: Path, target: Path) -> None:
    """Empty the folder of a staged output; if a kill between two moves left the old output there, restore it."""
    if (work / PREVIOUS).exists() and not target.exists():
        (work / PREVIOUS).rename(target)
    for rest in work.iterdir():
        _remove(rest)


def _put_away(work: Path, target: Path) -> None:
    _clear(work, target)
    work.rmdir()


def _take_place(new: Path, target: Path) -> None:
    if not new.exists():
        return
    if not (target.is_dir() or (new.is_dir() and target.exists())):
        new.replace(target)
        return
    target.rename(new.with_name(PREVIOUS))
    new.rename(target)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None


@contextmanager
def _locked(folder: Path, what: Path) -> Iterator[None]:
    """Make a folder and lock it. The kernel releases the lock when the process dies, and no lock file remains.

    A file system without locks gives no protection.
    """
    made: list[Path] = []
    handle = _lock(folder, what, made)
    try:
        yield
    finally:
        for place in made:
            with suppress(OSError):
                place.rmdir()
        os.close(handle)


def _lock(folder: Path, what: Path, made: list[Path]) -> int:
    for _ in range(_TRIES):
        made += [place for place in (folder, *folder.absolute().parents) if not place.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # the run before has just taken it away
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            if _take(handle, fcntl.LOCK_EX) and _is_at(handle, folder):
                return handle
            os.close(handle)
        time.sleep(_PAUSE_S)
    raise OutputError(f"{what}: is being written by another run; wait for it or choose another place")


def _is_at(handle: int, folder: Path) -> bool:
    return folder.exists() and os.path.samestat(os.fstat(handle), folder.stat())


def _take(handle: int, how: int) -> bool:
    try:
        fcntl.flock(handle, how | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _TAKEN
    return True
