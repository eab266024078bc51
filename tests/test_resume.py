"""A run that was killed or broken off is gone on with, and ends as an unbroken one."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hybridmap import checkpoints, provenance, session
from hybridmap.cli.app import app
from hybridmap.config import Config
from hybridmap.errors import BackendError, ConfigError, OutputError, StoreError, StreamError
from hybridmap.mapper import Mapper
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.sensor_models import CameraModel
from hybridmap.store import SessionFolder, checkpoint
from hybridmap.store.checkpoint import UnusableError
from hybridmap.streams import open_stream
from hybridmap.streams.base import SeekableStream
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.trajectory import NS_PER_S
from tests.streams_for_tests import RoomDrive

CONFIG = Config.load("laser", {"backends.names": ["gtsam-gnc", "relaxation-ratslam"]})
SCRIPT = """
import sys, time
from pathlib import Path
from hybridmap import checkpoints, session
from tests.streams_for_tests import RoomDrive
from tests.test_resume import CONFIG
class Stops(RoomDrive):
    def __iter__(self):
        for number, sample in enumerate(super().__iter__()):
            if number > 300:
                print("there", flush=True)
                time.sleep(60)
            yield sample
session.run(Stops(laps=2.2), CONFIG, Path(sys.argv[1]))
"""


class Breaks(RoomDrive):
    """A drive whose sensors fail after so many samples."""

    after = 300

    def __iter__(self):
        for number, sample in enumerate(super().__iter__()):
            if number == self.after:
                raise StreamError("the cable is loose")
            yield sample


def full_disk(*_: object) -> None:
    """What a file that cannot be written does."""
    raise OutputError("no space left on device")


def contents(folder: Path) -> dict[str, object]:
    """All that a session holds, but for the times that it took."""
    with sqlite3.connect(folder / "map.db") as connection:
        tables = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        found: dict[str, object] = {
            table: sorted(connection.execute(f"SELECT * FROM {table}").fetchall(), key=repr)
            for table in tables
            if table != "solutions"
        }
        found["solutions"] = connection.execute("SELECT backend, position, poses FROM solutions ORDER BY 1").fetchall()
    trajectories = sorted((folder / "trajectory").iterdir())
    return found | {path.name: path.read_bytes() for path in [*trajectories, folder / "config.yaml"]}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    out = tmp_path_factory.mktemp("unbroken") / "s"
    session.run(RoomDrive(laps=2.2), CONFIG, out)
    return contents(out)


@pytest.fixture
def often(monkeypatch):
    """Checkpoints at every node."""
    monkeypatch.setattr(checkpoints, "LEAST_S", 0.0)
    monkeypatch.setattr(checkpoints, "AHEAD_S", 1e9)
    monkeypatch.setattr(checkpoints, "SOON", 0.0)


def broken_off(out: Path, after: int = 300) -> None:
    stream = Breaks(laps=2.2)
    stream.after = after
    with pytest.raises(StreamError, match="cable"):
        session.run(stream, CONFIG, out)


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("after", [120, 300])
def test_a_broken_off_run_is_resumed_to_the_same_session(unbroken, tmp_path, after):
    broken_off(tmp_path / "s", after)
    seen: list[int] = []
    session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True, progress=lambda done, _: seen.append(done))
    assert seen[0] > after // 4  # it does not begin anew
    assert contents(tmp_path / "s") == unbroken
    assert not (tmp_path / "s" / "checkpoint").exists()


def test_a_killed_run_is_resumed_to_the_same_session(unbroken, tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(tmp_path / "s")], stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"there\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert (tmp_path / "s" / "checkpoint").is_file()
    session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True)
    assert contents(tmp_path / "s") == unbroken


@pytest.mark.usefixtures("often")
def test_a_resumed_run_that_breaks_off_again_is_resumed_again(unbroken, tmp_path):
    broken_off(tmp_path / "s", 120)
    stream = Breaks(laps=2.2)
    with pytest.raises(StreamError, match="cable"):
        session.run(stream, CONFIG, tmp_path / "s", resume=True)
    session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True)
    assert contents(tmp_path / "s") == unbroken


@pytest.mark.usefixtures("often")
def test_a_run_that_fails_at_its_very_end_is_resumed_there(unbroken, tmp_path, monkeypatch):

    with monkeypatch.context() as broken:
        broken.setattr(SessionFolder, "write_metrics", full_disk)
        with pytest.raises(OutputError):
            session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s")
    seen: list[int] = []
    session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True, progress=lambda done, _: seen.append(done))
    assert not seen or seen[0] > 100
    assert contents(tmp_path / "s") == unbroken


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("number", range(6))
def test_a_run_that_fails_between_two_steps_of_its_end_is_resumed_there(unbroken, tmp_path, monkeypatch, number):
    steps = ["_flush", "_retime", "_conclude", "_solve_finally", "_look_again", "_measure_between_nodes"]

    def failing(_: Mapper) -> None:
        raise BackendError("out of memory")

    def done_before(_: Mapper) -> None:
        pytest.fail("a step is done again that was done before")

    with monkeypatch.context() as broken:
        broken.setattr(Mapper, steps[number], failing)
        with pytest.raises(BackendError):
            session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s")
    for step in ["step", *steps[:number]][: 2 * number]:
        monkeypatch.setattr(Mapper, step, done_before)
    session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True)
    assert contents(tmp_path / "s") == unbroken


def test_without_a_checkpoint_the_drive_is_mapped_from_its_beginning(unbroken, tmp_path, caplog):
    for spoil in (Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:-9]), lambda path: path.write_text("{}")):
        broken_off(tmp_path / "s")
        spoil(tmp_path / "s" / "checkpoint")
        caplog.clear()
        session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True)
        assert "mapping from the beginning" in caplog.text
        assert contents(tmp_path / "s") == unbroken
        (tmp_path / "s").rename(tmp_path / f"done{len(list(tmp_path.iterdir()))}")


def test_a_checkpoint_names_nothing_but_what_a_state_is_made_of(tmp_path):
    broken_off(tmp_path / "s")
    path = tmp_path / "s" / "checkpoint"
    head = json.loads(path.read_bytes().partition(b"\n")[0])
    harm = b"cposix\nsystem\n(S'touch harm'\ntR."
    for content in (harm, harm.replace(b"posix\nsystem", b"hybridmap.output\nwrite_text")):
        path.write_bytes(json.dumps(head | {"crc32": zlib.crc32(content)}).encode() + b"\n" + content)
        with pytest.raises(UnusableError, match="not among what a state may hold"):
            checkpoint.read(path, {})


@pytest.mark.usefixtures("often")
def test_it_is_refused_with_another_source_or_configuration_or_code(tmp_path, monkeypatch):
    broken_off(tmp_path / "s")
    before = (tmp_path / "s" / "map.db").read_bytes()
    other = Config.load("laser", {"backends.names": ["odometry"]})
    with pytest.raises(StoreError, match="another configuration"):
        session.run(RoomDrive(laps=2.2), other, tmp_path / "s", resume=True)
    with pytest.raises(StoreError, match="another source: found hall, expected room"):
        session.run(RoomDrive(laps=2.2, name="hall"), CONFIG, tmp_path / "s", resume=True)

    class Later(RoomDrive):
        def __iter__(self):
            stream = super().__iter__()
            next(stream)
            return stream

    with pytest.raises(StoreError, match="room has other samples"):
        session.run(Later(laps=2.2), CONFIG, tmp_path / "s", resume=True)
    monkeypatch.setattr(provenance, "mapping", lambda: "other")
    with pytest.raises(StoreError, match="another hybridmap"):
        session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True)
    assert (tmp_path / "s" / "map.db").read_bytes() == before


def test_a_finished_session_or_one_that_is_written_is_not_resumed(tmp_path, caplog):
    config = Config.load("laser", {"vision.sensor": "none"})
    done = session.run(RoomDrive(laps=0.2, with_scans=False), config, tmp_path / "s")
    again = session.run(RoomDrive(laps=0.2, with_scans=False), config, tmp_path / "s", resume=True)
    assert again.head == done.head
    assert "nothing to resume" in caplog.text
    with pytest.raises(StoreError, match="another configuration"):
        session.run(RoomDrive(laps=0.2, with_scans=False), CONFIG, tmp_path / "s", resume=True)
    broken_off(tmp_path / "held")
    with SessionFolder(tmp_path / "held").writing(resume=True), pytest.raises(OutputError, match="is being written"):
        session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "held", resume=True)


def test_a_resumed_overwrite_ends_with_one_session(unbroken, tmp_path):
    session.run(RoomDrive(laps=0.3), CONFIG, tmp_path / "s")
    with pytest.raises(StreamError, match="cable"):
        session.run(Breaks(laps=2.2), CONFIG, tmp_path / "s", overwrite=True)
    assert (tmp_path / "s" / ".previous" / "map.db").is_file()
    session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True)
    assert contents(tmp_path / "s") == unbroken
    assert not (tmp_path / "s" / ".previous").exists()


@pytest.mark.parametrize("name", ["gtsam-isam2", "gtsam-lm", "relaxation-weighted", "gtsam-cauchy", "odometry"])
@pytest.mark.usefixtures("often")
def test_every_kind_of_back_end_comes_to_the_same_map(name, tmp_path):
    config = Config.load("laser", {"backends.names": [name]})
    session.run(RoomDrive(laps=1.3), config, tmp_path / "whole")
    stream = Breaks(laps=1.3)
    stream.after = 200
    with pytest.raises(StreamError, match="cable"):
        session.run(stream, config, tmp_path / "s")
    session.run(RoomDrive(laps=1.3), config, tmp_path / "s", resume=True)
    assert contents(tmp_path / "s") == contents(tmp_path / "whole")


@pytest.mark.parametrize("taken", [1, 7, 40])
def test_a_stream_goes_on_with_the_same_samples(taken):
    config = Config.load("lab", {"simulation.duration_s": 1.0, "simulation.sensors": "both", "simulation.camera.rate_hz": 5.0})
    stream = open_stream("lab", config)
    assert isinstance(stream, SeekableStream)
    whole = list(stream)
    counts = dict(stream.report.counts)
    assert stream.first_stamps(3) == tuple(sample.stamp_ns for sample in whole[:3])
    samples = iter(stream)
    for _ in range(taken):
        next(samples)
    onward = list(stream.onward(taken, stream.report))
    assert [sample.stamp_ns for sample in onward] == [sample.stamp_ns for sample in whole[taken:]]
    frames = [[one for one in samples if isinstance(one, RgbdFrame)] for samples in (onward, whole[taken:])]
    assert all(np.array_equal(a.color, b.color) for a, b in zip(*frames, strict=True))
    assert stream.report.counts == counts


def test_a_part_of_a_simulated_drive_is_that_of_the_whole_and_is_not_rendered_again(monkeypatch):
    config = Config.load("lab", {"simulation.duration_s": 2.0, "simulation.sensors": "rgbd", "simulation.camera.rate_hz": 5.0})
    whole = list(open_stream("lab", config))
    part = open_stream("lab", config, start_s=0.5, end_s=1.5)
    samples, first = list(part), whole[0].stamp_ns
    expected = [sample for sample in whole if 0.5 <= (sample.stamp_ns - first) / 1e9 <= 1.5]
    assert [sample.stamp_ns for sample in samples] == [sample.stamp_ns for sample in expected]
    frames = [[one for one in some if isinstance(one, RgbdFrame)] for some in (samples, expected)]
    assert len(frames[0]) == part.expected_observations == part.report.counts["frames"]
    assert all(np.array_equal(a.color, b.color) for a, b in zip(*frames, strict=True))
    rendered: list[int] = []
    frame = CameraModel.frame

    def counted(*given):
        rendered.append(given[1])
        return frame(*given)

    monkeypatch.setattr(CameraModel, "frame", counted)
    assert isinstance(part, SeekableStream)
    assert len(list(part.onward(len(samples) - 8, part.report))) == 8
    assert len(rendered) < 3
    with pytest.raises(StreamError, match="no odometry between --start and --end"):
        open_stream("lab", config, start_s=100.0)


@pytest.mark.parametrize("left", [0, 10, 5000, -20000])
def test_a_run_whose_map_is_damaged_is_not_resumed_and_what_to_do_is_said(unbroken, tmp_path, left):
    """Cut to so many bytes, or damaged in so many bytes before its end."""
    broken_off(tmp_path / "s")
    path = tmp_path / "s" / "map.db"
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    content = path.read_bytes()
    path.write_bytes(content[:left] if left >= 0 else content[:left] + bytes(-left))
    with pytest.raises(StoreError, match=r"map\.db.*--overwrite"):
        session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", resume=True)
    assert path.is_file()
    session.run(RoomDrive(laps=2.2), CONFIG, tmp_path / "s", overwrite=True)
    assert contents(tmp_path / "s") == unbroken


@pytest.mark.usefixtures("often")
def test_a_resumed_run_opens_its_source_once(tmp_path):
    config = Config.load("lab", {"simulation.duration_s": 4.0, "vision.sensor": "none", "backends.names": ["odometry"]})
    opened: list[int] = []

    class Counted(SimulatedStream):
        def onward(self, taken, report):
            opened.append(taken)
            for sample in super().onward(taken, report):
                if sample.stamp_ns > self.first_stamps(1)[0] + 3 * NS_PER_S and len(opened) == 1:
                    raise StreamError("the cable is loose")
                yield sample

    stream = Counted(config.simulation, 0)
    with pytest.raises(StreamError, match="cable"):
        session.run(stream, config, tmp_path / "s")
    session.run(stream, config, tmp_path / "s", resume=True)
    assert len(opened) == 2
    assert opened[1] > 60


ROOM = ("laser", "scan-to-map", "bionic-laser", "campus")
LAB = ("rgbd", "bionic", "ratslam", "paper")


@pytest.mark.parametrize("name", [*ROOM, *LAB])
def test_the_state_of_every_configuration_can_be_written_and_read(name, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(checkpoints, "LEAST_S", 0.0)
    overrides = {"simulation.world": "lab", "simulation.sensors": "rgbd", "simulation.duration_s": 2.0}
    config = Config.load(name, overrides if name in LAB else {})
    stream = open_stream("lab", config) if name in LAB else RoomDrive(laps=0.4)
    with monkeypatch.context() as broken:
        broken.setattr(SessionFolder, "write_metrics", full_disk)
        with pytest.raises(OutputError):
            session.run(stream, config, tmp_path / "s")
    assert "cannot be resumed" not in caplog.text
    assert (tmp_path / "s" / "checkpoint").is_file()
    assert checkpoints.resumable(SessionFolder(tmp_path / "s"), stream, config) is not None


def test_the_command_resumes_a_finished_session_by_saying_so(tmp_path):
    (tmp_path / "drive.csv").write_text("stamp_s,v_m_s,omega_rad_s\n" + "".join(f"{i},0.5,0.1\n" for i in range(20)))
    arguments = ["map", str(tmp_path / "drive.csv"), "--out", str(tmp_path / "s"), "--json"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert CliRunner().invoke(app, [*arguments, "--resume"]).exit_code == 0
    refused = CliRunner().invoke(app, [*arguments, "--resume", "--overwrite"])
    assert isinstance(refused.exception, ConfigError)


@pytest.mark.slow
def test_killed_runs_and_readers_are_proved_by_the_tool():
    tool = Path(__file__).parents[1] / "tools" / "kill_proof.py"
    command = [sys.executable, str(tool), "lab", "--config", "laser", "--end", "10"]
    done = subprocess.run(
        [*command, "--kills", "2", "--errors", "3", "--readers", "2", "--pairs", "1", "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    figures = {row["name"]: row for row in json.loads(done.stdout)["metrics"]}
    judged = [row for name, row in figures.items() if row.get("passed") is not None and not name.endswith("cpu_ratio")]
    assert len(judged) >= 10
    assert all(row["passed"] for row in judged)


def test_of_a_live_drive_nobody_is_told_to_resume_it(tmp_path, caplog):
    stream = Breaks(laps=2.2)
    stream.after = 300
    with pytest.raises(StreamError, match="cable"):
        session.run(stream, CONFIG, tmp_path / "s", repeatable=False)
    caplog.clear()
    SessionFolder(tmp_path / "s").require()
    assert "a live drive cannot be resumed" in caplog.text
    assert "--resume" not in caplog.text
