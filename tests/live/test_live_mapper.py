"""A live mapper makes the map of a recording, answers at once, and ends cleanly whoever dies."""

import os
import signal

import numpy as np
import pytest

from hybridmap import session
from hybridmap.config import Config
from hybridmap.errors import ConfigError, LiveError, OutputError, StreamError
from hybridmap.live import LiveLimits, LiveMapper
from hybridmap.store import MapStore
from hybridmap.streams.base import Observation, Rig
from tests.streams_for_tests import RoomDrive

CONFIG = Config.load("laser")
PATIENT = LiveLimits(lag_s=600.0)
"""A drive is fed faster than it can be mapped; nothing is to be left out."""
LATE_NS = 310_000_000


def as_they_arrive(drive):
    """The samples of a drive in the order in which they come if scans come later than odometry of the same moment."""
    return sorted(drive, key=lambda sample: sample.stamp_ns + LATE_NS * isinstance(sample, Observation))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return session.run(RoomDrive(laps=2.2, bias_rad_per_m=0.1), CONFIG, tmp_path_factory.mktemp("recorded") / "s")


def test_the_map_is_that_of_the_recording_whatever_the_order_across_sources(recorded, tmp_path):
    drive = RoomDrive(laps=2.2, bias_rad_per_m=0.1)
    with LiveMapper(CONFIG, drive.rig, tmp_path / "s", limits=PATIENT) as mapper:
        for sample in as_they_arrive(drive):
            mapper.add(sample)
        mapper.save()
        with MapStore.open(tmp_path / "s") as store:
            assert store.solutions()
            assert not store.ended
        finished = mapper.finish()
        assert mapper.report.dropped == {}
        assert mapper.report.state == "finished"
    assert finished.head["graph_hash"] == recorded.head["graph_hash"] == mapper.snapshot.graph_hash
    assert finished.head["stream"] == {"odometry": 277, "scans": 139}
    with MapStore.open(tmp_path / "s") as store:
        np.testing.assert_array_equal(mapper.snapshot.poses, store.solutions()[store.primary].poses)


def test_a_killed_mapping_process_is_one_clear_error_and_poses_go_on(tmp_path):
    drive = RoomDrive(laps=0.5)
    mapper = LiveMapper(CONFIG, drive.rig, tmp_path / "s")
    samples = list(drive)
    for sample in samples[:20]:
        mapper.add(sample)
    os.kill(mapper.pid, signal.SIGKILL)
    with pytest.raises(LiveError, match="ended by signal 9"):
        mapper.finish(10.0)
    with pytest.raises(LiveError, match="ended by signal 9"):
        mapper.add(samples[20])
    assert mapper.report.state == "failed"
    assert np.isfinite(mapper.pose_map_robot()).all()


def test_what_cannot_be_set_up_is_said_at_once(tmp_path):
    with pytest.raises(StreamError, match="laser"):
        LiveMapper(CONFIG, Rig(), tmp_path / "s")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        LiveMapper(CONFIG, RoomDrive().rig, tmp_path)
    with pytest.raises(ConfigError):
        LiveMapper(Config.load("laser", {"vision.sensor": "none such"}), RoomDrive().rig, tmp_path / "s")
