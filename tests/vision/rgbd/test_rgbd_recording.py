"""The one real RGB-D recording: hand-held, level camera assumed by its calibration."""

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.evaluate.edge_errors import edge_errors
from hybridmap.geometry import align, transform_points
from hybridmap.graph.edges import EdgeKind
from hybridmap.mapper import Mapper
from hybridmap.streams.open import open_stream
from tests.narrowing import known


def ate_m(poses, truth):
    fitted = transform_points(align(truth, poses), poses[:, :2])
    return float(np.sqrt(np.mean(np.sum((fitted - truth[:, :2]) ** 2, axis=1))))


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("odometry", "bar_m"), [("odometry.txt", 0.025), ("odometry_hard.txt", 0.028)])
def test_hand_held_office_beats_its_odometry_with_covariances_of_the_right_size(data_dir, odometry, bar_m):
    folder = data_dir / "real" / "hololens_office"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    config = Config.load("rgbd", {"sensors.odometry_file": odometry, "backends.names": ["gtsam-gnc"]})
    stream = open_stream(folder, config)
    mapper = Mapper(config, stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    nodes = mapper.map.nodes
    truth = known(stream.groundtruth).at([node.stamp_ns for node in nodes])
    raw = np.array([node.pose_odom for node in nodes])
    mapped = mapper.belief().poses_map_node
    assert ate_m(raw, truth) > 3.0 * bar_m
    assert ate_m(mapped, truth) < bar_m
    errors = edge_errors(mapper.map, known(stream.groundtruth))
    assert all(0.3 < errors[kind].chi2_ratio < 2.0 for kind in (EdgeKind.REGISTRATION, EdgeKind.LOOP))
