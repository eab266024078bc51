"""Whole recordings of real robots, one configuration for all: node poses and every scan against verified relations."""

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.evaluate.relations import read_relations, relation_errors
from hybridmap.geometry import compose
from hybridmap.graph.experience_map import Status
from hybridmap.graph.pose_graph import EdgeKind
from hybridmap.mapper import Mapper
from hybridmap.streams import open_stream
from hybridmap.trajectory import Trajectory


def mapped(path):
    """Trajectory at every scan of the recording, by the primary back-end."""
    config = Config.load("laser", {"backends.names": ["gtsam-gnc"]})
    stream = open_stream(path, config)
    mapper = Mapper(config, stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    retraced = mapper.vision.retrace(mapper.belief())
    return Trajectory(retraced.stamps_ns, compose(mapper.poses()[retraced.nodes], retraced.deltas)), mapper


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    ("log", "file", "bar_m", "bar_loop_m"), [("fr079", "fr079.mcap", 0.048, 0.070), ("aces", "aces.bag", 0.040, 0.062)]
)
def test_relation_errors_of_a_real_log(data_dir, log, file, bar_m, bar_loop_m):
    folder = data_dir / "real" / log
    if not (folder / file).is_file():
        pytest.skip(f"{folder / file} is not here")
    trajectory, mapper = mapped(folder / file)
    errors = relation_errors(trajectory, read_relations(folder / "relations.txt"))
    assert errors.all.trans_mean_m <= bar_m
    assert errors.loops.trans_mean_m <= bar_loop_m
    final = mapper.poses()
    loops = [e for e in mapper.map.edges if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED]
    off = [np.hypot(*(compose(final[e.source], e.relative.delta) - final[e.target])[:2]) for e in loops]
    assert np.mean(np.array(off) > 1.0) <= 0.01
