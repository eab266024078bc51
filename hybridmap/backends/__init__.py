"""Back-ends: from a frozen graph to poses and a typed report, without knowledge of sensors. `create` makes one by name."""

from hybridmap.backends.base import Backend, Outcome, Solution, Solver, SolveReport, SolveStatus, SupportsPoseGraph
from hybridmap.backends.driver import Driver, Works, replay
from hybridmap.backends.graph_session import GraphSession
from hybridmap.backends.registry import create, names, register

__all__ = [
    "Backend",
    "Driver",
    "GraphSession",
    "Outcome",
    "Solution",
    "SolveReport",
    "SolveStatus",
    "Solver",
    "SupportsPoseGraph",
    "Works",
    "create",
    "names",
    "register",
    "replay",
]
