"""Pose graphs as files (g2o and TORO in, g2o out; planar only), and the hash that says whether two of them are the same."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hybridmap.errors import GraphError, quoted
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.order import in_driving_order
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import GraphFile, PoseGraph
from hybridmap.output import write_text

log = logging.getLogger(__name__)

# Where xx, xy, xt, yy, yt, tt stand among the six numbers of a line.
_G2O_ORDER = (0, 1, 2, 3, 4, 5)
_TORO_ORDER = (0, 1, 4, 2, 5, 3)
_EDGES = {"EDGE_SE2": _G2O_ORDER, "EDGE2": _TORO_ORDER}
_VERTICES = ("VERTEX_SE2", "VERTEX2")
_FIX = "FIX"
_HIGHEST = 2**63 - 1
"""Number of a vertex, as g2o and arrays hold it."""
_UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(slots=True)
class _Lines:
    vertices: dict[int, list[float]] = field(default_factory=dict)
    ends: list[tuple[int, int]] = field(default_factory=list)
    deltas: list[list[float]] = field(default_factory=list)
    upper: list[list[float]] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)  # of the lines of the edges
    fixed: list[int] = field(default_factory=list)


def read_graph(path: Path) -> PoseGraph:
    """Read a planar g2o (`VERTEX_SE2`, `EDGE_SE2`) or TORO (`VERTEX2`, `EDGE2`) file.

    Vertices are numbered again from 0 in the order of the drive; edges keep the file's order. That order, and which edges are
    odometry, `graph.order.in_driving_order` finds: where consecutive numbers are all joined by edges, these edges are the
    odometry, and every other one is a loop. If the file has no vertices, initial poses are composed along its edges. The
    first vertex that a `FIX` line names is the one that is held; nothing else is fixed. What the numbers mean is not checked:
    see `PoseGraph.validate`.

    Raises:
        GraphError: no such file, a damaged line (named), a 3-D file, a vertex given twice or missing, no edge; or no vertices,
            and edges that do not join all nodes.
    """
    if not path.is_file():
        raise GraphError(f"{path}: no such graph file; expected a g2o or TORO file")
    lines = _Lines()
    text = path.read_text(encoding="utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split("#", 1)[0].split()
        if fields:
            _parse(lines, fields, f"{path}:{number}")
            lines.numbers += [number] * (len(lines.ends) - len(lines.numbers))
    if not lines.ends:
        vertices = {0: "no vertex", 1: "1 vertex"}.get(len(lines.vertices), f"{len(lines.vertices)} vertices")
        raise GraphError(f"{path}: holds {vertices} and no edge; expected EDGE_SE2 or EDGE2 lines of a g2o or TORO file")
    return _assemble(lines, path)


def _parse(lines: _Lines, fields: list[str], where: str) -> None:
    tag = fields[0]
    if tag in _EDGES:
        source, target = _integers(fields, 2, where)
        numbers = _numbers(fields, 3, 9, where)
        lines.ends.append((source, target))
        lines.deltas.append(numbers[:3])
        lines.upper.append([numbers[3 + k] for k in _EDGES[tag]])
    elif tag in _VERTICES:
        (vertex,) = _integers(fields, 1, where)
        if vertex in lines.vertices:
            raise GraphError(f"{where}: vertex {vertex} is given twice; delete one of its lines")
        lines.vertices[vertex] = _numbers(fields, 2, 3, where)
    elif "SE3" in tag or tag in ("VERTEX3", "EDGE3"):
        raise GraphError(f"{where}: {tag} is a 3-D record; only planar graphs (SE2) can be read")
    elif tag == _FIX:
        lines.fixed += _integers(fields, len(fields) - 1, where)
    else:
        known = ", ".join((*_VERTICES, *_EDGES, _FIX))
        raise GraphError(f"{where}: unknown record {quoted(tag)}, expected one of {known}")


def _integers(fields: list[str], count: int, where: str) -> list[int]:
    given = fields[1 : 1 + count]
    try:
        numbers = [int(field) for field in given]
        if len(numbers) < count:
            raise ValueError
    except ValueError:
        raise GraphError(
            f"{where}: expected {count} whole number(s) after {fields[0]}, found {quoted(' '.join(given))}"
        ) from None
    if max(map(abs, numbers), default=0) > _HIGHEST:
        raise GraphError(f"{where}: found {quoted(' '.join(given))}, expected vertex numbers of at most {_HIGHEST}")
    return numbers


def _numbers(fields: list[str], start: int, count: int, where: str) -> list[float]:
    if len(fields) != start + count:
        raise GraphError(f"{where}: expected {start + count - 1} numbers after {fields[0]}, found {len(fields) - 1}")
    try:
        numbers = [float(field) for field in fields[start:]]
    except ValueError:
        raise GraphError(f"{where}: expected numbers after {fields[0]}, found {quoted(' '.join(fields[start:]))}") from None
    if not np.isfinite(numbers).all():
        raise GraphError(f"{where}: found NaN or Inf, expected finite numbers")
    return numbers


def _assemble(lines: _Lines, path: Path) -> PoseGraph:
    names = sorted(lines.vertices) or sorted({end for ends in lines.ends for end in ends})
    index = {name: i for i, name in enumerate(names)}
    for number, (source, target) in zip(lines.numbers, lines.ends, strict=True):
        for end in (source, target):
            if end not in index:
                raise GraphError(f"{path}:{number}: edge {source} -> {target} names vertex {end}, which the file does not give")
    sources = np.array([index[s] for s, _ in lines.ends], dtype=np.int64)
    targets = np.array([index[t] for _, t in lines.ends], dtype=np.int64)
    initial = np.array([lines.vertices[name] for name in names]) if lines.vertices else np.zeros((len(names), 3))
    graph = PoseGraph(
        initial=initial,
        sources=sources,
        targets=targets,
        deltas=np.array(lines.deltas),
        information=np.array(lines.upper)[:, _UPPER],
        kinds=np.full(len(sources), EdgeKind.LOOP, dtype=np.int8),
        edge_ids=np.arange(len(sources), dtype=np.int64),
        file=GraphFile(
            path, np.array(names, dtype=np.int64), np.array(lines.numbers, dtype=np.int64), _held(lines, index, path)
        ),
    )
    graph = in_driving_order(graph).graph
    return graph if lines.vertices else chain(graph)


def _held(lines: _Lines, index: dict[int, int], path: Path) -> int | None:
    unknown = [vertex for vertex in lines.fixed if vertex not in index]
    if unknown:
        raise GraphError(f"{path}: FIX names vertex {unknown[0]}, which the file does not give")
    if len(set(lines.fixed)) > 1:
        log.warning("%s: FIX names %d vertices; vertex %d is held, the others may move", path, len(lines.fixed), lines.fixed[0])
    return index[lines.fixed[0]] if lines.fixed else None


def held(graph: PoseGraph, poses: Array) -> Array:
    """Poses (N, 3) moved rigidly, so that the node that the graph's file fixes is where the file has it.

    They are returned as they are if it fixes none, or node 0, which every solver holds.
    """
    node = None if graph.file is None else graph.file.held
    if not node:
        return poses
    moved = compose(graph.initial[node], between(poses[node], poses))
    moved[node] = graph.initial[node]
    return moved


def write_g2o(path: Path, graph: PoseGraph, poses: Array) -> None:
    """Write the nodes at `poses` (N, 3), m and rad, and all edges as a g2o file; one that exists is replaced.

    Numbers have 17 significant digits; the file appears at once when it is complete. A graph that was read from a file keeps
    the numbers of its vertices, and the line `FIX` if the file has one; else none is written. The format has no kinds of
    edges: read back, every edge between non-consecutive nodes is a loop.

    Raises:
        OutputError: the file cannot be written.
    """
    names = np.arange(graph.n_nodes) if graph.file is None else graph.file.vertices
    rows = [f"VERTEX_SE2 {name} {_row(pose)}\n" for name, pose in zip(names, poses, strict=True)]
    if graph.file is not None and graph.file.held is not None:
        rows.append(f"{_FIX} {names[graph.file.held]}\n")
    upper = graph.information[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    ends = zip(names[graph.sources], names[graph.targets], graph.deltas, upper, strict=True)
    rows += [f"EDGE_SE2 {s} {t} {_row(delta)} {_row(info)}\n" for s, t, delta, info in ends]
    write_text(path, "".join(rows))


def _row(numbers: Array) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)


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
