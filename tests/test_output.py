"""One module keeps every output: the same promises for all who use it."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.context import ForkProcess
from pathlib import Path

import pytest

from hybridmap.errors import OutputError
from hybridmap.output import Kind, held, is_held, staged, write_bytes, write_text
from hybridmap.report.comparison_page import COMPARISON
from hybridmap.simulation.writers.messages import RECORDING
from hybridmap.store import SessionFolder
from hybridmap.study.folder import STUDY_FOLDER
from hybridmap.verification.page import VERIFICATION

Midway = Callable[[], object]
"""What is called in the middle of a run."""

Fresh = Callable[["User", str], dict[str, bytes]]
"""What a run leaves of a text in a place where nothing was."""

HEAD = '<meta name="generator" content="hybridmap 1.0">'


def session(path: Path, text: str, midway: Midway, overwrite: bool) -> None:
    with SessionFolder(path).writing(overwrite=overwrite):
        for name in ("map.db", "config.yaml", "metrics.json", "reference/groundtruth.tum"):
            write_text(path / name, text)
        midway()
        write_text(path / "trajectory" / "odometry.tum", text)


def study(path: Path, text: str, midway: Midway, overwrite: bool) -> None:
    with held(path, STUDY_FOLDER, overwrite=overwrite):
        write_text(path / "cells" / "ab" / "abcd.json", text)
        midway()
        write_text(path / "cells.csv", text)


def page(kind: Kind) -> Callable[[Path, str, Midway, bool], None]:
    def write(path: Path, text: str, midway: Midway, overwrite: bool) -> None:
        with held(path, kind, overwrite=overwrite) as place:
            midway()
            with place.replaced():
                write_text(path / kind.files[1], text)
                midway()
                write_text(path / kind.files[0], HEAD + text)

    return write


def recorded_file(path: Path, text: str, midway: Midway, overwrite: bool) -> None:
    with staged(path, kind=RECORDING, overwrite=overwrite) as work:
        (work / path.name).write_text(text)
        midway()


def recorded_folder(path: Path, text: str, midway: Midway, overwrite: bool) -> None:
    with staged(path, kind=RECORDING, overwrite=overwrite) as work:
        write_text(work / path.name / "metadata.yaml", text)
        midway()
        write_text(work / path.name / "part" / "1.mcap", text)


def exported(path: Path, text: str, midway: Midway, overwrite: bool) -> None:
    other = path.parent / f"{path.stem}.pgm"
    with staged(path, other, overwrite=overwrite) as work:
        write_text(work / other.name, text)
        midway()
        write_text(work / path.name, text)


@dataclass(frozen=True)
class User:
    """Who writes, how many times it can be stopped in the middle, and what is peculiar to it."""

    write: Callable[[Path, str, Midway, bool], None]
    stops: int = 1
    is_folder: bool = True
    continued: bool = False


USERS = {
    "session": User(session),
    "study": User(study, continued=True),
    "comparison": User(page(COMPARISON), stops=2),
    "verification": User(page(VERIFICATION), stops=2),
    "recorded folder": User(recorded_folder),
    "recorded file": User(recorded_file, is_folder=False),
    "exported files": User(exported, is_folder=False),
}
REPLACING = {name: user for name, user in USERS.items() if not user.continued}


def table(users: dict[str, User]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("user", users.values(), ids=users.keys())


def run(user: User, path: Path, text: str, *, midway: Midway = lambda: None, overwrite: bool = True) -> None:
    user.write(path, text, midway, overwrite)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones included, and every empty folder."""
    found = {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}
    return {str(path.relative_to(folder)): data for path, data in found.items() if path.is_file() or not any(path.iterdir())}


def failing(error: type[BaseException], at: int = 0) -> Midway:
    """What is called in the middle of a run and fails the `at`-th time."""
    calls: list[int] = []

    def midway() -> None:
        calls.append(1)
        if len(calls) > at:
            raise error

    return midway


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "deep" / "er" / "out.yaml"


@pytest.fixture
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Fresh:
    """What a run leaves in a place where nothing was."""

    def written(user: User, text: str) -> dict[str, bytes]:
        root = tmp_path_factory.mktemp("fresh")
        run(user, root / "deep" / "er" / "out.yaml", text)
        return contents(root)

    return written


@table(USERS)
def test_a_fresh_place_holds_what_was_written_and_nothing_else(user: User, tmp_path: Path, place: Path) -> None:
    run(user, place, "new", overwrite=False)
    found = contents(tmp_path)
    assert found
    assert all(data.endswith(b"new") for data in found.values())
    assert not [name for name in found if "/." in name]


@table(USERS)
def test_an_output_of_ours_is_replaced_only_when_asked_for(user: User, tmp_path: Path, place: Path, fresh: Fresh) -> None:
    run(user, place, "old")
    before = contents(tmp_path)
    if user.continued:
        run(user, place, "new", overwrite=False)
    else:
        with pytest.raises(OutputError, match=r"already.*--overwrite"):
            run(user, place, "new", overwrite=False, midway=lambda: pytest.fail("it ran"))
        assert contents(tmp_path) == before
        run(user, place, "new")
    assert contents(tmp_path) == fresh(user, "new")


@table(USERS)
@pytest.mark.parametrize("overwrite", [False, True])
def test_what_is_somebody_else_s_is_refused_and_stays(user: User, tmp_path: Path, place: Path, overwrite: bool) -> None:
    place.mkdir(parents=True)
    (place / "thesis.tex").write_text("years of work")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match=r"thesis\.tex" if user is not USERS["exported files"] else "is a folder"):
        run(user, place, "new", overwrite=overwrite, midway=lambda: pytest.fail("it ran"))
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["maps.png", "comparison.html", "metrics.json", ".previous/comparison.html", ".previous/a"])
def test_a_page_folder_is_known_by_its_page_and_by_no_name(tmp_path: Path, name: str) -> None:
    write_text(tmp_path / name, "mine: of hybridmap 1.0")
    with pytest.raises(OutputError, match="not empty and no comparison"):
        run(USERS["comparison"], tmp_path, "new")
    assert contents(tmp_path) == {name: b"mine: of hybridmap 1.0"}


@table({name: user for name, user in REPLACING.items() if user.is_folder and name != "recorded folder"})
def test_files_of_somebody_else_beside_an_output_stay(user: User, tmp_path: Path, place: Path, fresh: Fresh) -> None:
    run(user, place, "old")
    (place / "notes.txt").write_text("mine")
    with pytest.raises(MemoryError):
        run(user, place, "failed", midway=failing(MemoryError))
    run(user, place, "new")
    assert contents(tmp_path) == {**fresh(user, "new"), "deep/er/out.yaml/notes.txt": b"mine"}


@table({name: user for name, user in USERS.items() if name in ("session", "study", "comparison", "verification")})
def test_a_file_in_the_place_of_a_folder_is_refused(user: User, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/out")):
        with pytest.raises(OutputError, match=str(path)):
            run(user, path, "new")
    assert contents(tmp_path) == {"file": b"mine"}


@table(REPLACING)
@pytest.mark.parametrize("error", [MemoryError, ZeroDivisionError, OutputError, KeyboardInterrupt, SystemExit])
def test_a_run_that_fails_leaves_what_was_there(user: User, tmp_path: Path, error: type[BaseException]) -> None:
    for stop in range(user.stops):
        place = tmp_path / f"stop {stop}" / "out.yaml"
        if not (user is USERS["session"] and error is KeyboardInterrupt):
            with pytest.raises(error):
                run(user, place, "new", midway=failing(error, stop))
            assert not place.parent.exists()
        run(user, place, "old")
        before = contents(tmp_path)
        with pytest.raises(error):
            run(user, place, "new", midway=failing(error, stop))
        assert contents(tmp_path) == before


def test_a_first_session_that_is_broken_off_stays_as_far_as_it_got(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(USERS["session"], tmp_path / "s", "new", midway=failing(KeyboardInterrupt))
    assert (tmp_path / "s" / "map.db").read_text() == "new"


def test_a_study_that_fails_keeps_what_it_knows(tmp_path: Path) -> None:
    for error in (MemoryError, KeyboardInterrupt):
        with pytest.raises(error):
            run(USERS["study"], tmp_path / "s", "known", midway=failing(error))
    assert contents(tmp_path / "s") == {"cells/ab/abcd.json": b"known"}
    (tmp_path / "s" / "cells" / "ab" / ".abcd.json.partial").write_text("of a killed run")
    run(USERS["study"], tmp_path / "s", "known")
    assert not list(tmp_path.rglob("*.partial"))


fork = multiprocessing.get_context("fork")


def in_another_process(work: Callable[[], object]) -> ForkProcess:
    process = fork.Process(target=work)
    process.start()
    return process


def killed(user: User, path: Path, stop: int) -> None:
    """Overwrite in another process that is killed at its `stop`-th stop."""
    calls = []

    def midway() -> None:
        calls.append(1)
        if len(calls) > stop:
            os.kill(os.getpid(), signal.SIGKILL)

    process = in_another_process(lambda: run(user, path, "killed", midway=midway))
    process.join(30)
    assert process.exitcode == -signal.SIGKILL


@table(REPLACING)
def test_after_a_kill_the_next_run_finds_the_old_output_whole(user: User, tmp_path: Path, place: Path, fresh: Fresh) -> None:
    for stop in range(user.stops):
        killed(user, place, stop)
        run(user, place, "old")
        assert contents(tmp_path) == fresh(user, "old")
        killed(user, place, stop)
        with pytest.raises(MemoryError):
            run(user, place, "failed", midway=failing(MemoryError))
        assert contents(tmp_path) == fresh(user, "old")
        killed(user, place, stop)
        run(user, place, "new")
        assert contents(tmp_path) == fresh(user, "new")


class Killed(BaseException):
    """Nothing that the run still tries comes to pass."""


@table(REPLACING)
@pytest.mark.parametrize("fails", [False, True], ids=["ends", "fails"])
def test_a_kill_between_any_two_moves_loses_nothing(
    user: User, tmp_path: Path, fresh: Fresh, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    """At every move on the way: what the next run finds is the old output or the new one, whole."""
    midway = failing(MemoryError, user.stops - 1) if fails else (lambda: None)
    whole = [fresh(user, "old"), fresh(user, "new")]
    done: list[Path] = []
    for last in range(30):
        root = tmp_path / str(last)
        place = root / "deep" / "er" / "out.yaml"
        run(user, place, "old")
        done.clear()
        with monkeypatch.context() as patch:
            for name in ("rename", "replace"):
                patch.setattr(Path, name, killed_at(getattr(Path, name), last, done))
            with suppress(Killed, MemoryError):
                run(user, place, "new", midway=midway)
        survived = len(done) <= last
        with pytest.raises(MemoryError):
            run(user, place, "failed", midway=failing(MemoryError))
        if user is not USERS["exported files"]:  # two files take their places one after the other
            assert contents(root) in whole
        assert contents(root).keys() == whole[0].keys()
        if survived:
            return
    pytest.fail("there is no end to the moves")


def killed_at(move: Callable[[Path, Path], Path], last: int, done: list[Path]) -> Callable[[Path, Path], Path]:
    def moved(path: Path, target: Path) -> Path:
        done.append(path)
        if len(done) > last:
            raise Killed
        return move(path, target)

    return moved


@table(USERS)
def test_one_run_at_a_time_writes_a_place(user: User, tmp_path: Path, place: Path, fresh: Fresh) -> None:
    ready = fork.Event()

    def say_and_wait() -> None:
        ready.set()
        signal.pause()

    def other() -> None:
        run(user, place, "of another", midway=say_and_wait)

    run(user, place, "old")
    process = in_another_process(other)
    assert ready.wait(30)
    for overwrite in (False, True):
        with pytest.raises(OutputError, match=f"{place}.*another run|already"):
            run(user, place, "new", overwrite=overwrite, midway=lambda: pytest.fail("it ran"))
    with pytest.raises(OutputError, match=f"{place}.*another run"):
        run(user, place, "new")
    process.kill()  # a killed run holds nothing
    process.join()
    run(user, place, "new")
    assert contents(tmp_path) == fresh(user, "new")


def test_a_look_at_a_folder_does_not_keep_a_run_from_starting(tmp_path: Path) -> None:
    looking = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(looking, fcntl.LOCK_SH)  # as `is_held` does for an instant
    look = threading.Timer(0.05, os.close, [looking])
    look.start()
    with SessionFolder(tmp_path).writing():
        assert is_held(tmp_path)
        write_text(tmp_path / "map.db", "new")
    assert not is_held(tmp_path)
    look.join()


def test_a_folder_that_the_run_before_takes_away_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock, folder = fcntl.flock, tmp_path / "out"

    def taken_away_first(handle: int, how: int) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        folder.rmdir()
        lock(handle, how)

    monkeypatch.setattr(fcntl, "flock", taken_away_first)
    with held(folder, COMPARISON):
        assert is_held(folder)


def test_a_folder_that_cannot_be_written_to_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write to any folder
    with pytest.raises(OutputError, match="cannot be written: Permission denied"):
        run(USERS["comparison"], tmp_path, "new", midway=lambda: pytest.fail("it ran"))


def test_a_hidden_folder_of_somebody_else_is_not_taken_for_an_old_output(tmp_path: Path) -> None:
    run(USERS["session"], tmp_path, "old")
    write_text(tmp_path / ".previous" / "notes.txt", "mine")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match="not empty"):
        run(USERS["session"], tmp_path, "new")
    assert contents(tmp_path) == before


def test_a_recording_that_a_killed_run_had_set_aside_comes_back_and_is_not_overwritten_by_chance(tmp_path: Path) -> None:
    run(USERS["recorded folder"], tmp_path / "out", "old")
    before = contents(tmp_path)
    (tmp_path / ".out.new").mkdir()
    (tmp_path / "out").rename(tmp_path / ".out.new" / ".previous")
    with pytest.raises(OutputError, match="holds a recording already"):
        run(USERS["recorded folder"], tmp_path / "out", "new", overwrite=False)
    assert contents(tmp_path) == before


def test_the_root_is_no_file() -> None:
    with pytest.raises(OutputError, match="is a folder"):
        run(USERS["exported files"], Path("/"), "new")


def test_what_ended_just_before_a_kill_is_not_replaced_by_the_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    user = USERS["session"]
    run(user, tmp_path / "s", "old")
    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", failing_remove)
        with pytest.raises(Killed):
            run(user, tmp_path / "s", "new")
    with pytest.raises(MemoryError):
        run(user, tmp_path / "s", "failed", midway=failing(MemoryError))
    assert set(contents(tmp_path / "s").values()) == {b"new"}


def failing_remove(path: Path, ignore_errors: bool = False) -> None:
    if Path(path).is_dir():
        raise Killed


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("old")
    for path in (tmp_path / "folder", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match=f"{path}: cannot be written"):
            write_text(path, "new")
    assert contents(tmp_path) == {"folder": b"", "file": b"old"}
    write_bytes(tmp_path / "new" / "file", b"\x00\n")
    assert (tmp_path / "new" / "file").read_bytes() == b"\x00\n"
