"""From a source and options to a stream and a configuration."""

from pathlib import Path

import pytest

from hybridmap.cli.choose import choose
from hybridmap.streams import rosbag
from hybridmap.streams.bagindex import build_index
from tests.streams.recordings import laser_drive


@pytest.fixture
def readings(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """One entry each time that a bag is indexed."""
    done: list[str] = []

    def counted(bag, names, odom_frame, **options):
        done.append(str(bag.path))
        return build_index(bag, names, odom_frame, **options)

    monkeypatch.setattr(rosbag, "build_index", counted)
    return done


@pytest.mark.parametrize("config", [None, "laser"])
def test_a_bag_is_indexed_once(readings: list[str], tmp_path: Path, config: str | None) -> None:
    bag = laser_drive().write(tmp_path / "drive.mcap")
    chosen = choose(str(bag), config, {})
    assert chosen.config.vision.sensor == "laser"
    assert "laser" in chosen.stream.rig.sensors
    assert len(readings) == 1


def test_a_configuration_that_reads_otherwise_opens_the_bag_again(
    readings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hybridmap.config import Config

    bag = laser_drive().write(tmp_path / "drive.mcap")
    load = Config.load

    def other_sensors(name, overrides):
        return load(name, {**overrides, "sensors.latency_s": 0.7} if name == "laser" else overrides)

    monkeypatch.setattr(Config, "load", other_sensors)
    chosen = choose(str(bag), None, {})
    assert chosen.config.sensors.latency_s == 0.7
    assert len(readings) == 2


def test_a_simulated_robot_carries_the_laser_of_its_configuration() -> None:
    chosen = choose("office", "laser", {})
    assert "laser" in chosen.stream.rig.sensors
    assert "camera" not in chosen.stream.rig.sensors
