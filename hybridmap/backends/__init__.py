"""Solvers: one frozen graph in, poses and a typed report out. They know no sensors; `create` makes one by name."""

from hybridmap.backends.base import Backend, Solution, SolveReport, SolveStatus, SupportsPoseGraph
from hybridmap.backends.registry import create, names
from hybridmap.backends.replay import replay
from hybridmap.backends.session import GraphSession

__all__ = [
    "Backend",
    "GraphSession",
    "Solution",
    "SolveReport",
    "SolveStatus",
    "SupportsPoseGraph",
    "create",
    "names",
    "replay",
]
