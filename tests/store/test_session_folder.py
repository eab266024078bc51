from __future__ import annotations

import json
import math

import pytest

from hybridmap.errors import OutputError, StoreError
from hybridmap.metrics import Metric
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.base import Rig
from tests.store.sessions import ring_map, write_session


def killed_while_it_overwrote(folder):
    """What such a run leaves, and the map of the session that was there before."""
    session = write_session(folder, ring_map())
    before = session.map_db.read_bytes()
    (folder / ".previous").mkdir()
    for entry in sorted(folder.iterdir()):
        if entry.name != ".previous":
            entry.rename(folder / ".previous" / entry.name)
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


def test_a_run_that_is_refused_leaves_what_a_killed_one_mapped(tmp_path):
    session, _ = killed_while_it_overwrote(tmp_path / "s")
    so_far = session.map_db.read_bytes()
    with pytest.raises(OutputError, match="holds a session already"), session.writing():
        pass
    assert session.map_db.read_bytes() == so_far


def test_remains_of_a_run_that_died_early_can_be_overwritten(tmp_path):
    session = SessionFolder(tmp_path / "s")
    session.write_config("{}")
    with pytest.raises(OutputError, match="holds a session already"), session.writing():
        pass
    with session.writing(overwrite=True):
        assert not session.config_yaml.exists()
        session.write_config("new")
    assert session.config_yaml.read_text() == "new"


def test_a_reader_does_not_keep_a_run_from_its_end(tmp_path):
    session = SessionFolder(tmp_path / "s")
    with session.writing():
        store = MapStore.create(session.path, "{}", Rig(), "new")
        reader = MapStore.open(session.path)
        assert not reader.ended
        store.put_info("graph_hash", "0")
        store.close()
    assert reader.ended
    reader.close()
    session.require()
    with MapStore.open(session.path) as store:
        assert store.ended


@pytest.mark.parametrize("count", [1, 10])
def test_a_session_that_is_read_is_overwritten_all_the_same(tmp_path, count):
    session = write_session(tmp_path / "s", ring_map())
    readers = [MapStore.open(session.path) for _ in range(count)]
    before = [len(reader.map()) for reader in readers]
    with session.writing(overwrite=True):
        store = MapStore.create(session.path, "{}", Rig(), "new")
        during = [MapStore.open(session.path) for _ in range(count)]
        assert [reader.source for reader in during] == ["new"] * count
        store.put_info("graph_hash", "0")
        store.close()
    assert [len(reader.map()) for reader in readers] == before
    for reader in (*readers, *during):
        reader.close()
    with MapStore.open(session.path) as store:
        assert store.source == "new"
        assert store.ended
    assert not (session.path / ".previous").exists()


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
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="file: is a file, not a session folder"):
        SessionFolder(tmp_path / "file").require()


def test_a_map_that_was_cut_is_damaged_and_not_said_to_be_broken_off(tmp_path, caplog):
    write_session(tmp_path / "s", ring_map())
    content = (tmp_path / "s" / "map.db").read_bytes()
    for left in (len(content) // 3, 20, 0):
        (tmp_path / "s" / "map.db").write_bytes(content[:left])
        with pytest.raises(StoreError, match=r"map\.db: "):
            SessionFolder(tmp_path / "s").require()
    assert caplog.text == ""
