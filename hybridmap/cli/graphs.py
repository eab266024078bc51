"""The input of `optimize` and `compare`: a graph file, or the graph of a session."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybridmap.backends.pieces import pieces_of
from hybridmap.cli.choose import parse_settings
from hybridmap.config import Config
from hybridmap.config.backends import BackendsConfig
from hybridmap.config.gone import without_gone
from hybridmap.config.section import read_mapping
from hybridmap.errors import GraphError
from hybridmap.graph.gaps import Kidnapping, kidnappings
from hybridmap.graph.io import graph_hash, read_graph
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.store import MapStore, SessionFolder


@dataclass(frozen=True, slots=True)
class GraphSource:
    """A pose graph and where it was read from.

    Attributes:
        path: the graph file or session folder.
        graph: nodes and accepted edges.
        is_session: whether `path` is a session folder.
        start: origin of the graph's initial poses, in words (`dead reckoning`).
        head: facts about the graph for the JSON output, by key: `graph`, `nodes`, `edges`, `loops`, and more of a session.
        kidnapped: the places where the robot was kidnapped; empty for a graph file.
    """

    path: Path
    graph: PoseGraph
    is_session: bool
    start: str
    head: dict[str, Any] = field(default_factory=dict)
    kidnapped: tuple[Kidnapping, ...] = ()


def open_graph(path: Path) -> GraphSource:
    """Read the pose graph of a g2o or TORO file or of a session folder.

    Raises:
        GraphError: the file is missing, damaged or of another kind, or the session's map has no accepted edge.
        StoreError: the folder holds no session.
    """
    if not path.is_dir():
        graph = read_graph(path)
        return GraphSource(path, graph, is_session=False, start="the poses of the file", head=_head(path, graph))
    SessionFolder(path).require()
    with MapStore.open(path) as store:
        experiences = store.map()
    graph = experiences.pose_graph()
    if graph.n_edges == 0:
        raise GraphError(f"{path}: the map has no accepted edge; there is nothing to optimise")
    if len(pieces := pieces_of(graph)) > 1:
        raise GraphError(f"{path}: the map is {len(pieces)} pieces that are not joined; expected one, see `edit`")
    head = _head(path, graph) | {"graph_hash": graph_hash(experiences), "remarks": _doubts(SessionFolder(path))}
    return GraphSource(path, graph, is_session=True, start="dead reckoning", head=head, kidnapped=kidnappings(experiences))


def _doubts(folder: SessionFolder) -> list[str]:
    """What a verdict on the graph alone does not know: that the verdict on the drive was a bad one."""
    verdict = folder.read_metrics().head.get("verdict", "trusted") if folder.metrics_json.is_file() else "trusted"
    return [] if verdict == "trusted" else [f"the session is {verdict}; a verdict on its graph alone does not know why"]


def settings_of(source: GraphSource, config: str | None, setting: list[str] | None) -> BackendsConfig:
    """Settings of the back-ends for a graph.

    Args:
        source: the graph; a session brings its own settings, which are used if `config` is None. A file gets the defaults.
        config: name or path of a configuration; None: none.
        setting: `KEY=VALUE` entries of `--set`, applied last.

    Raises:
        ConfigError: the configuration does not exist or is not valid.
    """
    own = SessionFolder(source.path).config_yaml
    if config is not None or not source.is_session or not own.is_file():
        return Config.load(config, parse_settings(setting)).backends
    backends = without_gone({"backends": read_mapping(own).get("backends", {})})
    return Config.load(None, {**backends, **parse_settings(setting)}).backends


def _head(path: Path, graph: PoseGraph) -> dict[str, Any]:
    return {"graph": str(path), "nodes": graph.n_nodes, "edges": graph.n_edges, "loops": int(graph.is_loop.sum())}
