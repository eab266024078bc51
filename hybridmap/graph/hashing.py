"""The identity of a graph: one hash that is equal exactly when nodes and accepted edges are."""

from __future__ import annotations

import hashlib

import numpy as np

from hybridmap.geometry import Array
from hybridmap.graph.edges import Status
from hybridmap.graph.experience_map import ExperienceMap


def graph_hash(experiences: ExperienceMap) -> str:
    """SHA-256 over the nodes (stamps, initial poses) and the accepted edges (ends, kinds, deltas, covariances).

    Numbers enter as little-endian int64 and float64, negative zero as zero; scores, reasons, place codes and edges that
    are not part of the graph do not enter.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    stamps = np.array([node.stamp_ns for node in experiences.nodes], dtype="<i8")
    digest.update(np.int64(len(stamps)).astype("<i8").tobytes())
    digest.update(stamps.tobytes())
    digest.update(_float_bytes(experiences.initial))
    for edge in experiences.edges:
        if edge.status is not Status.ACCEPTED:
            continue
        digest.update(np.array([edge.source, edge.target, int(edge.kind)], dtype="<i8").tobytes())
        if edge.relative is not None:
            digest.update(_float_bytes(edge.relative.delta))
            digest.update(_float_bytes(edge.relative.covariance))
    return digest.hexdigest()


def _float_bytes(values: Array) -> bytes:
    return np.ascontiguousarray(np.asarray(values, dtype="<f8") + 0.0).tobytes()
