from __future__ import annotations

import fcntl
import json
import math
import os
import shutil
import threading
from pathlib import Path

import pytest

from hybridmap.errors import StoreError
from hybridmap.metrics import Metric
from hybridmap.store import MapStore, SessionFolder
from hybridmap.store.lock import is_being_written
from hybridmap.streams.base import Rig
from tests.store.sessions import ring_map, write_session


def test_a_session_is_refused_unless_overwritten_and_strangers_stay(tmp_path):
    session = write_session(tmp_path / "s", ring_map())
    (tmp_path / "s" / "notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="holds a session already"):
        session.prepare()
    session.prepare(overwrite=True)
    assert not session.map_db.exists()
    MapStore.create(session.path, "{}", Rig(), "new").close()
    session.keep()
    assert sorted(path.name for path in (tmp_path / "s").iterdir()) == ["map.db", "notes.txt"]


def test_a_failed_overwrite_brings_the_old_session_back(tmp_path):
    session = write_session(tmp_path / "s", ring_map())
    before = session.map_db.read_bytes()
    session.prepare(overwrite=True)
    MapStore.create(session.path, "{}", Rig(), "new").close()
    session.discard()
    assert session.map_db.read_bytes() == before
    assert session.groundtruth.is_file()
    assert not (session.path / ".previous").exists()


def write_and_fail(session, error):
    session.write_config("{}")
    MapStore.create(session.path, "{}", Rig(), "new").close()
    raise error


@pytest.mark.parametrize("error", [MemoryError, ZeroDivisionError, StoreError])
def test_a_failed_run_leaves_nothing_and_loses_nothing(tmp_path, error):
    old, new = write_session(tmp_path / "old", ring_map()), SessionFolder(tmp_path / "new")
    before = old.map_db.read_bytes()
    for session in (old, new):
        with pytest.raises(error), session.writing(overwrite=True):
            write_and_fail(session, error)
    assert old.map_db.read_bytes() == before
    assert not (tmp_path / "new").exists()


def test_two_runs_do_not_write_one_folder(tmp_path):
    session = SessionFolder(tmp_path / "s")
    with session.writing():
        for overwrite in (False, True):
            with pytest.raises(StoreError, match="is being written by another run"), session.writing(overwrite=overwrite):
                pass
        session.write_config("{}")
    with session.writing(overwrite=True):
        assert list(session.path.iterdir()) == [session.path / ".previous"]


def test_a_look_at_a_folder_does_not_keep_a_run_from_starting(tmp_path):
    looking = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(looking, fcntl.LOCK_SH)  # as one that asks whether it is being written
    look = threading.Timer(0.05, os.close, [looking])
    look.start()
    with SessionFolder(tmp_path).writing():
        assert is_being_written(tmp_path)
    look.join()


def killed_while_it_overwrote(folder):
    """What such a run leaves, and the map of the session that was there before."""
    session = write_session(folder, ring_map())
    before = session.map_db.read_bytes()
    session.prepare(overwrite=True)
    MapStore.create(session.path, "{}", Rig(), "new").close()
    return session, before


def test_a_session_that_did_not_end_says_so_and_where_the_one_before_is(tmp_path, caplog):
    session, before = killed_while_it_overwrote(tmp_path / "s")
    session.require()
    assert "broken off" in caplog.text
    assert f"{tmp_path}/s/.previous: move it" in caplog.text
    (tmp_path / "s" / ".previous").rename(tmp_path / "back")
    caplog.clear()
    back = SessionFolder(tmp_path / "back")
    back.require()
    assert caplog.text == ""
    assert back.map_db.read_bytes() == before
    session.require()
    assert "broken off" in caplog.text
    assert ".previous" not in caplog.text
    caplog.clear()
    with session.writing(overwrite=True):
        MapStore.create(session.path, "{}", Rig(), "new").close()
        session.require()
    assert "is still being written" in caplog.text


def test_the_next_run_puts_a_finished_session_back_first(tmp_path):
    session, before = killed_while_it_overwrote(tmp_path / "s")
    with pytest.raises(MemoryError), session.writing(overwrite=True):
        raise MemoryError
    assert session.map_db.read_bytes() == before


class Killed(BaseException):
    """Nothing that the run still tries comes to pass."""


def overwritten_and_failed(folder):
    with pytest.raises((MemoryError, Killed)), SessionFolder(folder).writing(overwrite=True):
        write_and_fail(SessionFolder(folder), MemoryError)


def test_a_kill_while_files_are_moved_loses_none(tmp_path, monkeypatch):
    write_session(tmp_path / "s", ring_map(0.1))
    before = contents(tmp_path / "s")
    rename = Path.rename
    done: list[Path] = []

    def killed_at(last):
        def renamed(path, target):
            if len(done) == last:
                raise Killed
            done.append(target)
            return rename(path, target)

        return renamed

    for last in range(14):  # six moves set it aside, six bring it back
        shutil.copytree(tmp_path / "s", tmp_path / str(last))
        done.clear()
        with monkeypatch.context() as patch:
            patch.setattr(Path, "rename", killed_at(last))
            overwritten_and_failed(tmp_path / str(last))
        overwritten_and_failed(tmp_path / str(last))
        assert contents(tmp_path / str(last)) == before
    assert len(done) < last  # the last of them was not killed at all


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_a_finished_session_replaced_does_not_come_back(tmp_path):
    """Killed between the end of its run and the removal of the session set aside."""
    session = write_session(tmp_path / "s", ring_map())
    before = session.map_db.read_bytes()
    (tmp_path / "s" / ".previous").mkdir()
    (tmp_path / "s" / ".previous" / "config.yaml").write_text("{}")
    with pytest.raises(MemoryError), session.writing(overwrite=True):
        raise MemoryError
    assert session.map_db.read_bytes() == before


def test_a_folder_of_something_else_is_refused_even_with_overwrite(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    for overwrite in (False, True):
        with pytest.raises(StoreError, match=r"no session.*thesis\.tex"):
            SessionFolder(tmp_path).prepare(overwrite=overwrite)
    assert (tmp_path / "thesis.tex").read_text() == "x"
    with pytest.raises(StoreError, match="is a file"):
        SessionFolder(tmp_path / "thesis.tex").prepare()


def test_remains_of_a_run_that_died_early_can_be_overwritten(tmp_path):
    session = SessionFolder(tmp_path)
    session.write_config("{}")
    with pytest.raises(StoreError, match="holds a session already"):
        session.prepare()
    session.prepare(overwrite=True)
    session.keep()
    assert list(tmp_path.iterdir()) == []


def test_metrics_are_merged_by_name_and_keep_the_head(tmp_path):
    session = SessionFolder(tmp_path)
    session.write_metrics({"graph_hash": "abc"}, [Metric("a/x", 1.0, "m", "A"), Metric("b/x", math.nan, "1", "B", 2.0, True)])
    session.merge_metrics([Metric("c/x", 3.0, "s", "C"), Metric("a/x", 5.0, "m", "A")])
    read = session.read_metrics()
    assert read.head == {"graph_hash": "abc"}
    assert [metric.name for metric in read.metrics] == ["a/x", "b/x", "c/x"]
    assert read.metrics[0].value == 5.0
    assert math.isnan(read.metrics[1].value)
    assert read.metrics[1].bar == 2.0
    assert read.metrics[1].passed is True
    assert json.loads(session.metrics_json.read_text())["metrics"][1]["value"] is None


def test_damaged_metrics_are_named(tmp_path):
    session = SessionFolder(tmp_path)
    session.metrics_json.write_text("{")
    with pytest.raises(StoreError, match=r"metrics\.json: damaged"):
        session.read_metrics()


def test_require_says_what_is_missing(tmp_path):
    with pytest.raises(StoreError, match="no such session folder"):
        SessionFolder(tmp_path / "gone").require()
    with pytest.raises(StoreError, match="holds no session"):
        SessionFolder(tmp_path).require()
