"""A frozen graph grown anew, node by node, as the robot made it."""

from __future__ import annotations

from collections.abc import Iterator

from hybridmap.backends.base import Backend, Solution
from hybridmap.backends.following import prefix
from hybridmap.graph.pose_graph import PoseGraph


def replay(backend: Backend, graph: PoseGraph) -> Iterator[Solution]:
    """Feed a graph to `update` node by node; an edge enters when both of its ends exist.

    Raises:
        GraphError: the graph is malformed, or a node hangs on later ones only.
        BackendError: the solver failed.
    """
    for nodes in range(1, graph.n_nodes + 1):
        yield backend.update(prefix(graph, nodes))
