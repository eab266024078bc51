"""The scale of the scene: 1 indoors, larger outdoors, steady; and a drive outdoors that only a far-sighted robot follows."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.geometry import between
from hybridmap.mapper import Mapper
from hybridmap.simulation import SimulatedStream
from hybridmap.vision.laser.cloud import INDOORS, SCANS, Scale, Scene, build_field, cloud_of_scan, merged, merged_at
from hybridmap.vision.laser.front_end import LaserFrontEnd
from tests.vision.laser.laser_worlds import LASER, box, cast, ring, room

FIELD = np.array(box(-21, -22, 23, 21))


def ranges(metres: float) -> np.ndarray:
    return np.full(180, metres, dtype=np.float32)


def scene_of(*scans: np.ndarray) -> Scene:
    scene = Scene()
    for scan in scans:
        scene.observe(scan)
    return scene


@pytest.mark.parametrize("world", [room(), ring() + 7.0])
def test_rooms_and_corridors_have_the_scale_one(world):
    assert scene_of(*[cast(world, np.zeros(3))] * 20).scale == INDOORS


@pytest.mark.parametrize(("metres", "factor"), [(1.0, 1.0), (11.9, 1.0), (12.1, 1.5), (16.1, 2.0), (70.0, 2.0)])
def test_the_scale_grows_with_the_distance_of_the_walls(metres, factor):
    scale = scene_of(ranges(metres)).scale
    assert scale.factor == factor
    assert scale.range_max_m == pytest.approx(20.0 * factor**2)
    assert scale.cell_m == pytest.approx(0.05 * factor)


def test_far_walls_change_it_when_they_stay_and_nothing_makes_it_flicker():
    scene = scene_of(*[ranges(3.0)] * SCANS)
    assert [scene.observe(ranges(60.0)).factor for _ in range(SCANS // 2 - 1)] == [1.0] * (SCANS // 2 - 1)
    assert [scene.observe(ranges(60.0)).factor for _ in range(SCANS)][-1] == 2.0
    seen = {scene.observe(ranges(metres)).factor for metres in [13.0, 15.0] * SCANS}
    assert seen == {2.0}


def test_without_a_return_it_stays_as_it_is():
    scene = scene_of(ranges(60.0), *[ranges(np.nan)] * SCANS)
    assert scene.scale.factor == 2.0


def test_clouds_of_a_large_scene_are_far_and_coarse_and_keep_that_when_merged():
    scan = cast(FIELD, np.zeros(3))
    assert len(cloud_of_scan(scan, LASER)) == 0
    near, far = cloud_of_scan(cast(room(), np.zeros(3)), LASER), cloud_of_scan(scan, LASER, Scale(2.0))
    assert len(far) > 150
    assert np.hypot(*far.points.T).max() > 27.0
    assert (near.cell_m, far.cell_m, far.moved(np.ones(3)).cell_m, far.thinned(9).cell_m) == (0.05, 0.1, 0.1, 0.1)
    assert merged([near, far]).cell_m == merged_at([far, near], np.zeros((2, 3))).cell_m == build_field(far).cell_m == 0.1


def test_a_drive_outdoors_is_registered_all_the_way():
    drive = SimulatedStream(Config.load("campus", {"simulation.duration_s": 30.0}).simulation, 0)
    mapper = Mapper(Config.load("laser"), drive.rig)
    for sample in drive:
        mapper.add(sample)
    assert isinstance(mapper.vision, LaserFrontEnd)
    chain, truth = mapper.vision.atlas.chain, drive.groundtruth.at([node.stamp_ns for node in mapper.map.nodes])
    off = between(between(truth[0], truth[-1]), between(chain[0], chain[-1]))
    assert np.hypot(*off[:2]) < 0.2
    assert len(mapper.vision.atlas.pieces) == 1
