"""Names of back-ends: each once, ours first; and back-ends that need no name."""

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.base import Outcome
from hybridmap.backends.comparison import compare, metrics_of
from hybridmap.backends.driver import Driver
from hybridmap.backends.ensemble import Ensemble
from hybridmap.config import Config
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.mapper import Mapper
from hybridmap.metrics import StageClock
from hybridmap.store.records import report_from_json, report_to_json
from tests.backends.graphs_for_tests import laps


class Still:
    """A back-end that believes the graph's own poses."""

    name = "still"

    def solve(self, graph):
        report = backends.SolveReport(self.name, backends.SolveStatus.CONVERGED, "still", 0, 1.0, 1.0, 0.0)
        return backends.Solution(graph.initial, report)

    update = finish = solve


def test_a_back_end_that_is_made_already_is_taken_wherever_a_name_is():
    graph, _ = laps(np.random.default_rng(0), nodes=8, per_lap=4)
    assert [row.backend for row in compare(graph, [Still(), "odometry"])] == ["still", "odometry"]
    assert backends.create(still := Still()) is still
    ensemble = Ensemble(BackendsConfig(), StageClock(), [Still(), "odometry"])
    ensemble.update(graph)
    assert (ensemble.primary, list(ensemble.solutions)) == ("still", ["still", "odometry"])
    mapper = Mapper(Config.load(None, {"vision.sensor": "none"}), backends=[Still()])
    for stamp_s in np.arange(0.0, 4.0, 0.1):
        mapper.add_odometry(stamp_s, [0.5 * stamp_s, 0.0, 0.0])
    mapper.finish()
    assert list(mapper.backends.solutions) == ["still"]
    session = backends.GraphSession(Still())
    session.add_node(0)
    assert np.array_equal(session.solve().poses, np.zeros((1, 3)))


def test_back_ends_come_once_each_under_their_own_names():
    with pytest.raises(BackendError, match="still"):
        compare(laps(np.random.default_rng(0), nodes=8, per_lap=4)[0], [Still(), Still()])
    with pytest.raises(BackendError, match="still"):
        Ensemble(BackendsConfig(), StageClock(), [Still(), Still()])
    with pytest.raises(BackendError, match="gtsam-lm"):
        backends.register("gtsam-lm", lambda config: Still())


def test_a_figure_that_only_the_solver_knows_comes_through_to_comparison_and_map_file():
    def solve(graph, start):
        return Outcome(start, backends.SolveStatus.CONVERGED, "as it was", 1, figures={"iterations": 7.0, "stiffness": 3.0})

    graph, _ = laps(np.random.default_rng(0), nodes=8, per_lap=4)
    (row,) = compare(graph, [Driver("still", BackendsConfig(), solve)])
    assert row.solution is not None
    assert report_from_json(report_to_json(row.solution.report)).figures == {"iterations": 7.0, "stiffness": 3.0}
    (stiffness,) = (metric for metric in metrics_of([row]) if metric.name == "stiffness/still")
    assert (stiffness.value, stiffness.unit) == (3.0, "1")
