"""Every edge of a map is explained by the record of its decision, which the map file keeps."""

from __future__ import annotations

from pathlib import Path

import pytest

from hybridmap import session
from hybridmap.cli.choose import choose
from hybridmap.config import Config
from hybridmap.graph.edges import EdgeKind, Method, Search, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.gaps import kidnappings
from hybridmap.simulation import SimulatedStream
from hybridmap.store import MapStore
from tests.streams_for_tests import RoomDrive

SMALL = {
    "simulation.duration_s": 40.0,
    "simulation.camera.rate_hz": 3.0,
    "simulation.camera.width_px": 120,
    "simulation.camera.height_px": 90,
    "backends.names": ["odometry"],
}


def explained(experiences: ExperienceMap) -> ExperienceMap:
    """The map, once each of its edges was found to be in the graph if and only if its record says so."""
    for edge in experiences.edges:
        assert (edge.status is Status.ACCEPTED) == (not edge.failed and edge.lack is None), edge
        assert edge.method is not None, edge
        assert edge.search is not None, edge
        assert edge.status is Status.ACCEPTED or edge.otherwise, edge
        assert edge.checks or edge.lack or edge.kind is EdgeKind.ODOMETRY or edge.method is Method.LOOPS, edge
    return experiences


def mapped(stream, config: Config, folder: Path) -> ExperienceMap:
    session.run(stream, config, folder)
    with MapStore.open(folder) as store:
        return explained(store.map())


def test_each_edge_of_a_laser_map_is_explained(tmp_path):
    experiences = mapped(RoomDrive(laps=2.2), Config.load("laser", {"backends.names": ["gtsam-gnc"]}), tmp_path / "s")
    assert {edge.search for edge in experiences.edges} >= {Search.CHAIN, Search.GATE, Search.NEAR}
    assert Status.REJECTED in {edge.status for edge in experiences.edges}


def test_each_edge_of_a_camera_map_is_explained(tmp_path):
    config = Config.load("lab", SMALL)
    experiences = mapped(SimulatedStream(config.simulation, 1), config, tmp_path / "s")
    refused = [edge for edge in experiences.edges if edge.status is Status.REJECTED]
    assert {edge.kind for edge in refused} >= {EdgeKind.LOOP}
    assert {edge.search for edge in experiences.edges} >= {Search.CHAIN, Search.GATE}


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("recording", ["fr079/fr079.mcap", "aces/aces.bag"])
def test_each_edge_of_a_recording_is_explained(data_dir: Path, tmp_path: Path, recording):
    source = data_dir / "real" / recording
    if not source.is_file():
        pytest.skip(f"{source} is not here")
    chosen = choose(str(source), None, {})
    mapped(chosen.stream, chosen.config, tmp_path / "s")


@pytest.mark.slow
@pytest.mark.parametrize("config", ["laser", "rgbd"])
@pytest.mark.parametrize("carried", [False, True])
def test_each_edge_of_an_office_is_explained_also_where_the_robot_is_kidnapped(tmp_path, config, carried):
    settings = {"simulation.world": "office"} | ({"simulation.carried_m": 20.0} if carried else {})
    chosen = Config.load(config, settings)
    experiences = mapped(SimulatedStream(chosen.simulation, 1), chosen, tmp_path / "s")
    assert len(kidnappings(experiences)) == carried
    if carried:
        assert any(edge.search is Search.WHOLE_MAP and edge.kind is EdgeKind.LOOP for edge in experiences.edges)
