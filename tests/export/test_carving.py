"""What the robot drove over is free in the grid, and unknown is never free to those who read the file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from hybridmap.errors import ExportError
from hybridmap.export.carving import Footprint, driven, swept
from hybridmap.export.costs import INSCRIBED, LETHAL, UNKNOWN_COST, clearance_m, costs, fits
from hybridmap.export.formats import ExportOptions, export_session, open_view
from hybridmap.export.keyframes import OccupancyGrid, build_grid
from hybridmap.geometry import compose, interpolate
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.streams.base import Rig
from tests.store.sessions import CAMERA, ring_map, write_session

SIDE = 0.05


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A session of a camera that does not see the floor that it drives on."""
    return write_session(tmp_path_factory.mktemp("carved") / "depth", ring_map(), rig=Rig(camera=CAMERA))


def cells_at(grid: OccupancyGrid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    column, row = np.floor((points[:, :2] - grid.origin_m) / grid.resolution_m).astype(int).T
    return row, column


@pytest.mark.parametrize("radius_m", [0.1, 0.3])
def test_the_robot_fits_wherever_it_was(folder, radius_m):
    view = open_view(folder.path, None, ExportOptions(footprint=Footprint.disc(radius_m)))
    with view.store:
        grid, way = build_grid(view), view.trajectory.poses
    around = np.array([[radius_m * np.cos(a), radius_m * np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 40)])
    for pose in way[::10]:
        assert grid.free[cells_at(grid, compose(pose, 0.9 * around))].all()
    room = fits(clearance_m(~grid.free, grid.resolution_m), grid.resolution_m, radius_m)
    assert room[cells_at(grid, way)].all()


def test_carving_adds_free_cells_and_changes_no_other(folder):
    grids = []
    for radius_m in (1e-3, 0.2):
        view = open_view(folder.path, None, ExportOptions(footprint=Footprint.disc(radius_m)))
        with view.store:
            grids.append(build_grid(view))
    small, large = grids
    shift = np.rint((small.origin_m - large.origin_m) / SIDE).astype(int)
    height, width = small.log_odds.shape
    part = large.log_odds[shift[1] : shift[1] + height, shift[0] : shift[0] + width]
    changed = part != small.log_odds
    assert changed.sum() > 500
    assert (part[changed] < 0).all()
    rows, columns = np.nonzero(changed)
    points = small.origin_m + SIDE * (np.stack([columns, rows], axis=1) + 0.5)
    assert np.abs(np.hypot(points[:, 0], points[:, 1] - 2.0) - 2.0).max() < 0.2 + 2 * SIDE


def test_the_way_between_two_poses_is_driven_too():
    poses = np.array([[1.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
    covered = swept((60, 90), np.zeros(2), SIDE, [poses], Footprint.disc(0.2))
    assert covered[17:23, 20:60].all()
    assert 1.0 <= covered.sum() * SIDE**2 / (2.0 * 0.4 + np.pi * 0.04) < 1.0 + SIDE / 0.2  # half a cell on either side
    apart = swept((60, 90), np.zeros(2), SIDE, [poses[:1], poses[1:]], Footprint.disc(0.2))
    assert apart.sum() * SIDE**2 == pytest.approx(2 * np.pi * 0.04, rel=0.3)


def test_a_long_robot_that_turns_covers_what_its_corners_pass():
    long = Footprint.parse("0.5,0.1 -0.5,0.1 -0.5,-0.1 0.5,-0.1")
    assert long.radius_m == pytest.approx(0.1)
    assert long.reach_m == pytest.approx(np.hypot(0.5, 0.1))
    straight = swept((40, 40), np.zeros(2), SIDE, [np.array([[1.0, 1.0, 0.0]])], long)
    turned = swept((40, 40), np.zeros(2), SIDE, [np.array([[1.0, 1.0, 0.0], [1.0, 1.0, np.pi - 1e-6]])], long)
    assert straight.sum() * SIDE**2 == pytest.approx(0.2, rel=0.4)
    assert turned.sum() * SIDE**2 == pytest.approx(np.pi * 0.26, rel=0.15)


@pytest.mark.parametrize("text", ["", "x", "0", "-0.2", "nan", "0.1 0.2", "0.1,0.2", "1,1 2,1 2,2", "1,1 2,2 3", "0,0 1,1 2,2"])
def test_what_is_no_footprint_is_refused(text):
    with pytest.raises(ExportError, match="footprint"):
        Footprint.parse(text)


def test_nobody_drove_where_the_robot_was_carried(folder):
    view = open_view(folder.path, None, ExportOptions())
    with view.store:
        track = view.store.track()
        whole = driven([track], view.experiences, view.poses)
        carried = ring_map()
        chain = next(edge for edge in carried.edges if (edge.source, edge.target) == (20, 21))
        carried.add_edge(Edge(20, 21, EdgeKind.REGISTRATION, Status.ACCEPTED, chain.relative, since_node=24, kidnapped_m=3.0))
        parted = driven([track], carried, view.poses)
    assert len(parted) == len(whole) + 1
    between = interpolate(view.poses[20], view.poses[21], 0.5)[:2]
    nearest = [min(np.hypot(*(stretch[:, :2] - between).T).min() for stretch in way) for way in (whole, parted)]
    assert nearest[0] < 0.05 < 0.1 < nearest[1]


def test_a_footprint_that_covers_the_walls_is_refused(folder, tmp_path):
    wide = replace(ExportOptions(), footprint=Footprint.disc(6.0))
    with pytest.raises(
        ExportError, match=r"footprint: a robot that reaches 6.03 m .* occupied cells; expected its true size, in m"
    ):
        export_session(folder.path, "grid", tmp_path / "map.yaml", options=wide)
    assert list(tmp_path.iterdir()) == []


def test_of_a_map_that_grew_meanwhile_only_the_known_nodes_count(folder):
    view = open_view(folder.path, None, ExportOptions())
    with view.store:
        view.poses = view.poses[:10]
        stretches = view.driven
    assert [len(stretch) for stretch in stretches[1:]] == [1] * 10
    assert np.hypot(*(stretches[0][-1, :2] - view.poses[9, :2])) < 0.4


def test_unknown_is_never_free_by_the_rules_of_map_servers(folder, tmp_path):
    export_session(folder.path, "grid", tmp_path / "map.yaml")
    head = yaml.safe_load((tmp_path / "map.yaml").read_text())
    pixels = np.unique(np.frombuffer((tmp_path / "map.pgm").read_bytes().split(b"\n", 3)[3], np.uint8))
    assert pixels.tolist() == [0, 205, 254]
    occupied, unknown, free = (255 - pixels.astype(np.float32)) / np.float32(255)
    assert occupied > head["occupied_thresh"] > unknown > 1.5 * head["free_thresh"] > free


def test_costs_fall_with_the_distance_and_unknown_has_none(folder, tmp_path):
    occupied = np.zeros((40, 80), dtype=bool)
    occupied[:, 0] = True
    free = ~occupied
    free[:, 70:] = False
    found = costs(occupied, free, SIDE, 0.2, 1.0)
    row = found[20].astype(int)
    assert row[0] == LETHAL
    assert (row[1:4] == INSCRIBED).all()
    assert (np.diff(row[:70]) <= 0).all()
    assert row[4] <= 98
    assert row[14] == round(98 * np.exp(-3 * (0.5 + 0.175 - 0.2)))
    assert (row[22:70] == 0).all()
    assert (row[70:] == UNKNOWN_COST).all()
    export_session(folder.path, "grid", tmp_path / "c.yaml", options=replace(ExportOptions(), inflation_m=0.5))
    assert yaml.safe_load((tmp_path / "c.yaml").read_text())["mode"] == "raw"
    pixels = np.frombuffer((tmp_path / "c.pgm").read_bytes().split(b"\n", 3)[3], np.uint8)
    assert {0, INSCRIBED, LETHAL, UNKNOWN_COST} <= set(pixels.tolist())
    assert set(pixels[pixels > LETHAL].tolist()) == {UNKNOWN_COST}
