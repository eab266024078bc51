"""False loops put into a graph: what cannot be done is said in one line."""

import numpy as np
import pytest

from hybridmap.errors import GraphError
from hybridmap.study.false_loops import inject
from tests.backends.graphs_for_tests import laps


def test_a_graph_without_loops_and_a_share_of_everything_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(GraphError, match=r"^graph: found no loops, expected at least one"):
        inject(laps(rng, nodes=10, per_lap=20)[0], 0.1, "random", rng)
    with pytest.raises(GraphError, match=r"share of 1\.0 false loops; expected 0 <= share < 1"):
        inject(laps(rng)[0], 1.0, "random", rng)
