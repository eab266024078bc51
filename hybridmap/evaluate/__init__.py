"""Errors of estimates against ground truth: trajectories, verified relations, loop closures, whole sessions."""

from hybridmap.evaluate.edge_errors import ClosureErrors, ClosureLimits, EdgeErrors, closure_errors, edge_errors
from hybridmap.evaluate.relations import RelationErrors, Relations, read_relations, relation_errors
from hybridmap.evaluate.session_errors import evaluate_session, session_trajectories
from hybridmap.evaluate.trajectory_errors import AbsoluteError, RelativeError, absolute_error, relative_error

__all__ = [
    "AbsoluteError",
    "ClosureErrors",
    "ClosureLimits",
    "EdgeErrors",
    "RelationErrors",
    "Relations",
    "RelativeError",
    "absolute_error",
    "closure_errors",
    "edge_errors",
    "evaluate_session",
    "read_relations",
    "relation_errors",
    "relative_error",
    "session_trajectories",
]
