"""A live mapper makes the map of a recording, answers at once, and ends cleanly whoever dies."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hybridmap import session
from hybridmap.config import Config
from hybridmap.errors import ExportError, LiveError, OutputError, StoreError, StreamError
from hybridmap.export.formats import ExportOptions, open_view
from hybridmap.geometry import between, compose, inverse
from hybridmap.live import LiveLimits, LiveMapper
from hybridmap.output import is_held
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.base import Observation, Rig, SelfMotion
from hybridmap.trajectory import read_tum
from tests.streams_for_tests import RoomDrive

CONFIG = Config.load("laser")
PATIENT = LiveLimits(lag_s=600.0)
"""A drive is fed faster than it can be mapped; nothing is to be left out."""
LATE_NS = 310_000_000


def as_they_arrive(drive):
    """The samples of a drive in the order in which they come if scans come later than odometry of the same moment."""
    return sorted(drive, key=lambda sample: sample.stamp_ns + LATE_NS * isinstance(sample, Observation))


def until(condition, timeout_s=60.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def drive():
    return RoomDrive(laps=1.5)


@pytest.fixture(scope="module")
def recorded(drive, tmp_path_factory):
    return session.run(drive, CONFIG, tmp_path_factory.mktemp("recorded") / "s")


def test_resets_from_several_threads_are_done_one_after_the_other(drive, tmp_path):
    with LiveMapper(CONFIG, drive.rig, tmp_path / "s", limits=PATIENT) as mapper:
        threads = [threading.Thread(target=mapper.reset, daemon=True) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
        assert not any(thread.is_alive() for thread in threads)
        for sample in as_they_arrive(drive):
            mapper.add(sample)
        assert mapper.finish(120.0).head["graph_hash"]


def test_the_map_is_that_of_the_recording_whatever_the_order_across_sources(drive, recorded, tmp_path):
    samples = as_they_arrive(drive)
    with LiveMapper(CONFIG, drive.rig, tmp_path / "s", limits=PATIENT) as mapper:
        with pytest.raises(ExportError, match="no node yet"):
            mapper.grid()
        for sample in samples[:100]:
            mapper.add(sample)
        until(lambda: mapper.report.nodes > 3)
        early, before = mapper.snapshot, mapper.snapshot.poses.copy()
        mapper.reset()
        assert mapper.report.nodes == mapper.report.samples["scans"] == 0
        for sample in samples:
            mapper.add(sample)
        until(lambda: mapper.report.lag_s == 0.0)
        mapper.save()
        with MapStore.open(tmp_path / "s") as store:
            assert store.primary in store.solutions()
            assert not store.ended
        finished = mapper.finish()
        assert mapper.report.dropped == {}
        assert mapper.report.state == "finished"
        with pytest.raises(LiveError, match="is finished"):
            mapper.add(samples[0])
    assert finished.head["graph_hash"] == recorded.head["graph_hash"] == mapper.snapshot.graph_hash
    assert finished.head["stream"] == {"odometry": 189, "scans": 95}
    with MapStore.open(tmp_path / "s") as store:
        np.testing.assert_array_equal(mapper.snapshot.poses, store.solutions()[store.primary].poses)
        assert len(mapper.snapshot.edges) == len(store.map().pose_graph().sources)
    np.testing.assert_array_equal(early.poses, before)
    for array in (early.poses, early.edges, early.kinds, early.stamps_ns, early.covariance):
        assert array is not None
        assert not array.flags.writeable


def test_everything_answers_while_the_mapper_does_not_and_what_is_left_out_is_said(drive, tmp_path):
    samples = as_they_arrive(drive)
    with LiveMapper(CONFIG, drive.rig, tmp_path / "s", limits=LiveLimits(lag_s=0.5)) as mapper:
        for sample in samples[:40]:
            mapper.add(sample)
        until(lambda: mapper.report.nodes > 0)
        os.kill(mapper.pid, signal.SIGSTOP)
        slowest_s = 0.0
        for sample in samples[40:240]:
            began_s = time.perf_counter()
            mapper.add(sample)
            pose = mapper.pose_map_robot()
            slowest_s = max(slowest_s, time.perf_counter() - began_s)
            if isinstance(sample, SelfMotion):
                np.testing.assert_allclose(pose, compose(mapper.pose_map_odom, sample.pose_odom_robot))
            time.sleep(0.01)
        assert slowest_s < 0.25  # on a machine that does much else
        report = mapper.report
        assert (mapper.grid(0.1, 60.0).log_odds > 0.0).sum() > 50
        with pytest.raises(LiveError, match=r"no answer in 0\.1 s"):
            mapper.save(0.1)
        os.kill(mapper.pid, signal.SIGCONT)
        for sample in samples[240:]:
            mapper.add(sample)
            time.sleep(0.02)
        finished = mapper.finish()
    assert report.dropped["scans"]["too slow"] > 20
    assert "odometry" not in report.dropped
    assert any("scans:" in one and "slower than they come" in one for one in mapper.doctor())
    dropped = mapper.report.dropped["scans"]["too slow"]
    assert finished.head["stream"] == {"odometry": 189, "scans": 95 - dropped, "scans left out (too slow)": dropped}
    (reason,) = [reason for reason in finished.head["reasons"] if reason["kind"] == "views dropped"]
    assert reason["value"] == pytest.approx(100.0 * dropped / 95)


def test_a_robot_is_found_on_a_finished_map_which_stays_as_it_is(drive, recorded, tmp_path):
    kept = recorded.folder.map_db.read_bytes()
    begun = 60  # the robot begins elsewhere on the lap, with its odometry at zero
    samples = [sample for sample in drive if sample.stamp_ns >= begun * 100_000_000]
    with LiveMapper(CONFIG, drive.rig, tmp_path / "s", limits=PATIENT) as mapper:
        with pytest.raises(StoreError, match="nowhere"):
            mapper.localise(tmp_path / "nowhere")
        assert mapper.pose_base_map is None
        mapper.localise(recorded.folder.path)
        for sample in samples:
            mapper.add(sample)
        mapper.guess((30.0, -20.0, 2.0))  # wrong: it is found all the same
        until(lambda: mapper.pose_base_map is not None)
        until(lambda: mapper.report.lag_s == 0.0)
        pose_base_map = mapper.pose_base_map
        assert pose_base_map is not None
        there = compose(pose_base_map, mapper.pose_map_robot())
        mapper.localise(recorded.folder.path)
        mapper.guess(there)  # right: looked for at once
        until(lambda: mapper.pose_base_map is not None)
        guessed = mapper.pose_base_map
        assert guessed is not None
        np.testing.assert_allclose(between(pose_base_map, guessed), np.zeros(3), atol=0.1)
        mapper.localise(None)
        assert mapper.pose_base_map is None
    off = between(read_tum(recorded.folder.trajectory / f"{recorded.head['primary_backend']}.tum").poses[-1], there)
    assert np.hypot(off[0], off[1]) < 0.1
    assert abs(off[2]) < 0.05
    assert recorded.folder.map_db.read_bytes() == kept


def test_a_bad_sample_costs_itself_and_a_killed_mapping_process_is_one_clear_error(drive, tmp_path):
    mapper = LiveMapper(CONFIG, drive.rig, tmp_path / "s")
    mapper.add_odometry(0.0, (2.0, 1.0, 0.5))
    np.testing.assert_allclose(mapper.pose_map_robot(), np.zeros(3), atol=1e-12)  # the map begins where the robot is
    np.testing.assert_allclose(mapper.pose_map_odom, inverse([2.0, 1.0, 0.5]))
    for bad, said in (
        (lambda: mapper.add_odometry(0.1, (np.nan, 0.0, 0.0)), "NaN"),
        (lambda: mapper.add_odometry(0.1, (0.0, 0.0)), "shape"),
        (lambda: mapper.add_velocity(0.1, 0.0, 0.0), "mixed"),
        (lambda: mapper.add_scan(0.1, [1.0, 2.0]), "expected"),
        (lambda: mapper.add_scan(np.nan, drive.rig.sensors["laser"].bearings_rad), "stamp nan"),
        (lambda: mapper.add_rgbd(0.1, np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32)), "no camera"),
    ):
        with pytest.raises(StreamError, match=said):
            bad()
    assert mapper.report.samples == {"odometry": 1, "scans": 0}
    os.kill(mapper.pid, signal.SIGKILL)
    for call in (lambda: mapper.finish(10.0), lambda: mapper.add_odometry(0.1, np.zeros(3)), mapper.save, mapper.reset):
        with pytest.raises(LiveError, match="ended by signal 9"):
            call()
    assert mapper.report.state == "failed"
    np.testing.assert_allclose(mapper.pose_map_robot(), np.zeros(3), atol=1e-12)
    mapper.close()


ROBOT = """
import os, sys, signal, time
from pathlib import Path
from hybridmap.config import Config
from hybridmap.live import LiveLimits, LiveMapper
from tests.streams_for_tests import RoomDrive

drive = RoomDrive(laps=0.5)
mapper = LiveMapper(Config.load("laser"), drive.rig, Path(sys.argv[1]), limits=LiveLimits(lag_s=600.0))
for sample in drive:
    mapper.add(sample)
while mapper.report.lag_s:
    time.sleep(0.01)
os.kill(mapper.pid, signal.SIGTERM)  # as a service manager does that stops the whole group
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_robot_whose_program_dies_keeps_its_map(tmp_path):
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", ROBOT, str(tmp_path / "s")], cwd=root, check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL
    until(lambda: not is_held(tmp_path / "s"))
    with MapStore.open(tmp_path / "s") as store:
        assert store.ended
    recorded = session.run(RoomDrive(laps=0.5), CONFIG, tmp_path / "recorded")
    assert SessionFolder(tmp_path / "s").read_metrics().head["graph_hash"] == recorded.head["graph_hash"]


REGISTERED = """
import sys
from pathlib import Path
from hybridmap.backends import registry
from hybridmap.config import Config
from hybridmap.errors import BackendError
from hybridmap.live import LiveMapper
from tests.streams_for_tests import RoomDrive

registry.register("mine", lambda config: registry.create("gtsam-gnc", config))
try:
    LiveMapper(Config.load("laser", {"backends.names": ["gtsam-gnc", "mine"]}), RoomDrive().rig, Path(sys.argv[1]))
except BackendError as error:
    print(error)
"""


def test_what_is_registered_in_this_program_alone_is_refused_at_the_start(tmp_path):
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", REGISTERED, str(tmp_path / "s")]
    done = subprocess.run(command, cwd=root, check=True, timeout=60, capture_output=True, text=True)
    assert "'mine'" in done.stdout
    assert "hybridmap.backends" in done.stdout
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("repeatable", [True, False])
def test_a_drive_that_cannot_be_had_again_is_not_said_to_be_resumable(repeatable, tmp_path, caplog):
    class Broken(RoomDrive):
        def __iter__(self):
            yield from super().__iter__()
            raise StreamError("torn")

    with pytest.raises(StreamError, match="torn"):
        session.run(Broken(laps=0.5), CONFIG, tmp_path / "s", repeatable=repeatable)
    assert ("--resume" in caplog.text) == repeatable
    with MapStore.open(tmp_path / "s") as store:
        assert store.nodes > 3


def test_what_cannot_be_set_up_is_said_at_once(tmp_path):
    with pytest.raises(StreamError, match="laser"):
        LiveMapper(CONFIG, Rig(), tmp_path / "s")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        LiveMapper(CONFIG, RoomDrive().rig, tmp_path)


def test_a_stored_solution_that_nodes_came_after_is_left_out_until_the_end(drive, tmp_path):
    kept = []

    def opened(mapper, store):
        kept.extend([mapper, store])

    class Stream(RoomDrive):
        def __iter__(self):
            for number, sample in enumerate(super().__iter__()):
                yield sample
                mapper, store = kept
                if number == 150:
                    solution = mapper.backends.solutions[mapper.backends.primary]
                    store.put_solution(mapper.backends.primary, solution.poses, solution.report)
                    store.commit()
                    assert store.solutions()
            assert store.solutions() == {}
            view = open_view(store.path.parent, None, ExportOptions())
            assert len(view.poses) == len(mapper.map)
            view.store.close()

    session.run(Stream(laps=1.0), CONFIG, tmp_path / "s", opened=opened)
