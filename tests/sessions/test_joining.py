"""Maps of several drives: joined where several views agree, apart where none does, and given back bit for bit."""

from __future__ import annotations

import hashlib
import sqlite3

import numpy as np
import pytest

from hybridmap.backends.pieces import pieces_of, solve_by_piece
from hybridmap.backends.registry import create
from hybridmap.config import Config
from hybridmap.errors import StoreError
from hybridmap.geometry import align, between, compose
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.session import run
from hybridmap.sessions.joining import merge
from hybridmap.store import MapStore
from hybridmap.store.parts import copy_sessions
from hybridmap.streams.open import open_stream
from hybridmap.trajectory import read_tum


def drive(world, folder, start_s, end_s, seed, sensors="laser"):
    """Map part of a drive; the drive through a world is the same for every seed, the errors of its sensors are not."""
    named = {"simulation.world": world, "seed": seed, "backends.names": ["gtsam-gnc"], "neural.modules": 0}
    config = Config.load(sensors, named)
    return run(open_stream(world, config, start_s=start_s, end_s=end_s), config, folder).folder.path


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    root = tmp_path_factory.mktemp("drives")
    here = drive("lab", root / "here", 0.0, 22.0, 1)
    there = drive("lab", root / "there", 10.0, 36.0, 2)
    return here, there, drive("office", root / "elsewhere", 0.0, 12.0, 3)


@pytest.fixture(scope="module")
def joined(drives, tmp_path_factory):
    return merge(drives[0], drives[1], tmp_path_factory.mktemp("joined") / "both")


def rows(path):
    """All that a map file holds, table by table."""
    with sqlite3.connect(path / "map.db" if path.is_dir() else path) as file:
        names = [row[0] for row in file.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
        return {name: sorted(file.execute(f"SELECT * FROM {name}").fetchall()) for name in names}


def test_a_second_drive_is_found_on_the_map_of_the_first(drives, joined):
    """Begun elsewhere, half a lap on, it lies on the first within centimetres; no edge of motion leads to it."""
    assert joined.joined
    with MapStore.open(joined.folder.path) as store:
        experiences, poses = store.map(), store.solutions()["gtsam-gnc"].poses
        tracks = [store.track(number).stamps_ns for number in (0, 1)]
    here, there = experiences.sessions
    truths = [read_tum(path / "reference" / "groundtruth.tum") for path in drives[:2]]
    true = np.concatenate(
        [
            truth.at(experiences.stamps_ns[list(nodes)]) for truth, nodes in zip(truths, (here, there), strict=True)
        ]
    )  # fmt: skip
    error_m = np.hypot(*(compose(align(true, poses), poses) - true)[:, :2].T)
    assert np.sqrt(np.mean(error_m**2)) < 0.03
    assert all(len(track) > 100 for track in tracks)
    across = [e for e in experiences.edges if (e.source in here) != (e.target in here) and e.status is Status.ACCEPTED]
    assert not any(edge.kind is EdgeKind.ODOMETRY for edge in across)
    assert sum(edge.kind is EdgeKind.LOOP for edge in across) >= 4


def test_the_maps_that_are_read_stay_as_they_are(drives, tmp_path):
    before = [hashlib.sha256((path / "map.db").read_bytes()).hexdigest() for path in drives[:2]]
    merge(drives[0], drives[1], tmp_path / "both")
    assert [hashlib.sha256((path / "map.db").read_bytes()).hexdigest() for path in drives[:2]] == before


def test_every_part_comes_back_bit_for_bit(drives, joined, tmp_path):
    with MapStore.open(joined.folder.path) as whole:
        for number, path in enumerate(drives[:2]):
            with MapStore.create(tmp_path / str(number), whole.config_yaml, whole.rig, "") as store:
                copy_sessions(whole, store, [number])
            assert rows(tmp_path / str(number)) == rows(path)


def test_what_is_not_found_stays_apart_and_says_so(drives, tmp_path):
    """A drive through another building: two pieces, each as it was alone, and a verdict that says it."""
    apart = merge(drives[0], drives[2], tmp_path / "apart")
    assert not apart.joined
    assert [reason["kind"] for reason in apart.head["reasons"]] == ["not joined"]
    with MapStore.open(apart.folder.path) as store, MapStore.open(drives[2]) as alone:
        nodes = store.map().sessions[1]
        poses, own = store.solutions()["gtsam-gnc"].poses[list(nodes)], alone.solutions()["gtsam-gnc"].poses
    assert between(poses[0], poses) == pytest.approx(between(own[0], own), abs=1e-3)
    assert not any((edge.source in nodes) != (edge.target in nodes) for edge in accepted(apart.folder.path))


def accepted(folder):
    with MapStore.open(folder) as store:
        return [edge for edge in store.map().edges if edge.status is Status.ACCEPTED]


def test_every_piece_has_a_frame_of_its_own(drives, tmp_path):
    apart = merge(drives[0], drives[2], tmp_path / "apart")
    with MapStore.open(apart.folder.path) as store:
        graph, config = store.map().pose_graph(), Config.from_tree(store.config_tree, "test")
    pieces = pieces_of(graph)
    assert len(pieces) == 2
    solved = solve_by_piece(create("gtsam-gnc", config.backends).solve, graph).poses
    for nodes in pieces:
        assert solved[nodes[0]] == pytest.approx(graph.initial[nodes[0]])


def test_other_sensors_are_refused(drives, tmp_path):
    config = Config.load("laser", {"simulation.world": "lab", "simulation.laser.beams": 90, "backends.names": ["gtsam-gnc"]})
    run(open_stream("lab", config, end_s=4.0), config, tmp_path / "other")
    with pytest.raises(StoreError, match="other sensors"):
        merge(drives[0], tmp_path / "other", tmp_path / "both")
    assert not (tmp_path / "both").exists()
