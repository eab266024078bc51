"""A disk that is full, or may not be written to, costs nothing that was mapped; what is said is one line."""

from __future__ import annotations

import resource
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from hybridmap.errors import OutputError, StoreError
from hybridmap.store import MapStore, SessionFolder, schema
from hybridmap.streams.base import Rig
from tests.store.test_power_loss import check_beginning, write_node

LIMIT = 300_000
SCRIPT = """
import resource, signal, sys
from pathlib import Path
from hybridmap.store import MapStore
from hybridmap.streams.base import Rig
from tests.store.test_power_loss import write_node
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, resource.RLIM_INFINITY))
store = MapStore.create(Path(sys.argv[1]), "{{}}", Rig(), "drive")
for number in range(400):
    write_node(store, number)
    store.commit()
    print(number, flush=True)
    if number % 50 == 49:
        store.sync()
"""


@pytest.mark.parametrize("limit", [150_000, 300_000, 700_000])
def test_every_committed_node_is_there_after_a_disk_was_full(tmp_path, limit):
    """Files that may not grow, as on a full disk: of a map, of its log, and while the log is merged."""
    command = [sys.executable, "-c", SCRIPT.format(limit=limit), str(tmp_path / "s")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2], timeout=120)
    committed = len(done.stdout.split())
    assert 0 < committed < 400
    assert "cannot" in done.stderr.splitlines()[-1]
    assert check_beginning(tmp_path / "s", committed) == committed


def write_until_full(store: MapStore) -> None:
    for number in range(400):
        write_node(store, number)
        store.commit()


def test_a_map_can_be_broken_off_and_gone_on_with_after_the_disk_was_full(tmp_path):
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    store = MapStore.create(tmp_path / "s", "{}", Rig(), "drive")
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, hard))
        with pytest.raises(StoreError, match=r"map\.db: cannot write"):
            write_until_full(store)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    store.break_off("the disk was full")
    number = store.nodes
    store.close()
    assert check_beginning(tmp_path / "s", 1) == number
    with MapStore.open(tmp_path / "s") as read:
        assert read.broken_off == "the disk was full"
    with MapStore.resume(tmp_path / "s") as onward:
        write_node(onward, number)
        onward.commit()
    assert check_beginning(tmp_path / "s", number + 1) == number + 1


def test_a_map_in_a_folder_that_may_not_be_written_to_is_read_and_nothing_is_left_there(tmp_path, monkeypatch):
    folder = tmp_path / "s"
    with MapStore.create(folder, "{}", Rig(), "drive") as store:
        for number in range(3):
            write_node(store, number)
    monkeypatch.setattr("os.access", lambda *_: False)
    with (
        pytest.raises(OutputError, match="cannot be written: Permission denied"),
        SessionFolder(folder).writing(overwrite=True),
    ):
        pytest.fail("it was written to")
    assert check_beginning(folder, 3) == 3
    assert [path.name for path in folder.iterdir()] == [schema.MAP_NAME]


def test_a_log_that_cannot_be_looked_through_is_named(tmp_path, monkeypatch):
    """As on a disk that may only be read: SQLite has no place for the index of the log."""

    def refused(*_: object, **__: object) -> None:
        error = sqlite3.OperationalError("unable to open database file")
        error.sqlite_errorcode = sqlite3.SQLITE_CANTOPEN
        raise error

    with MapStore.create(tmp_path / "s", "{}", Rig(), "drive") as store:
        write_node(store, 0)
        store.commit()
        monkeypatch.setattr(sqlite3, "connect", refused)
        with pytest.raises(
            StoreError, match=r"its run did not end, .* copy the whole session folder to where it can be written"
        ):
            MapStore.open(tmp_path / "s")
