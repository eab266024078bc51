"""From a source to a frozen graph with a reference: simulated worlds, sessions, graph files, made-up laps."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.backends.base import SolveStatus
from hybridmap.backends.registry import LEAST_SQUARES, create
from hybridmap.config import Config
from hybridmap.errors import HybridMapError, StudyError
from hybridmap.geometry import Array, between, compose, exp
from hybridmap.graph.connectivity import chain
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.pose_graph import PoseGraph, prefix
from hybridmap.study import provenance
from hybridmap.study.model import SettingConfig, SourceConfig, SyntheticConfig
from hybridmap.trajectory import Trajectory

_ARRAYS = tuple(field.name for field in fields(PoseGraph) if field.name != "file")


@dataclass(frozen=True, slots=True)
class Frozen:
    """A graph that will not change any more, and what its nodes are compared with.

    Attributes:
        graph: without false loops or drift; None where there was none to be had.
        reference: (N, 3) m and rad, NaN where unknown.
        of_truth: whether the reference is the truth; else the optimum of the clean graph by `gtsam-lm`.
        failure: why there is no graph; empty otherwise.
    """

    graph: PoseGraph | None
    reference: Array
    of_truth: bool = False
    failure: str = ""

    def pack(self) -> bytes:
        """As bytes that `unpack` reads; the same content gives the same bytes."""
        arrays: dict[str, Any] = {"reference": self.reference, "of_truth": self.of_truth, "failure": self.failure}
        if self.graph is not None:
            given = {name: getattr(self.graph, name) for name in _ARRAYS}
            arrays |= {name: array for name, array in given.items() if array is not None}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        return buffer.getvalue()

    @classmethod
    def unpack(cls, data: bytes) -> Frozen:
        """Read what `pack` gave.

        Raises:
            ValueError, OSError, KeyError, zipfile.BadZipFile: it is damaged.
        """
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            given = {name: arrays[name] for name in _ARRAYS if name in arrays}
            graph = PoseGraph(**given) if given else None
            return cls(graph, arrays["reference"], bool(arrays["of_truth"]), str(arrays["failure"]))


@dataclass(frozen=True, slots=True)
class SourceTask:
    """How to come to a frozen graph; it may be sent to another machine, needs no file there and no other task.

    Attributes:
        key: digest of all that determines the graph and its reference.
        world: of the simulator, with `config`, `start_s` and `end_s`; None for a graph.
        clean: a frozen graph, packed, whose reference is still missing unless it is of truth.
        synthetic: of a made-up graph, with `seed`.
    """

    key: str
    world: str | None = None
    config: Mapping[str, Any] | None = None
    start_s: float | None = None
    end_s: float | None = None
    clean: bytes | None = None
    synthetic: SyntheticConfig | None = None
    seed: int = 0
    first_nodes: int | None = None


@dataclass(frozen=True, slots=True)
class SourceResult:
    """A frozen graph, packed, with the digest of the code that made it."""

    frozen: bytes
    code: str


def depends_on_seed(source: SourceConfig) -> bool:
    """Whether another seed gives another graph."""
    return source.world is not None or source.synthetic is not None


def task_of(source: SourceConfig, setting: SettingConfig, seed: int, read: Mapping[str, Frozen]) -> SourceTask:
    """The task for a source at a setting and seed; `read` holds the graphs of files and sessions, by title.

    Raises:
        ConfigError: the world's configuration cannot be used.
    """
    if source.world is not None:
        return _world_task(source, setting, seed)
    if source.synthetic is not None:
        identity = {"synthetic": source.synthetic.model_dump(), "seed": seed, "first": source.first_nodes}
        key = provenance.digest({**identity, "code": provenance.solving()})
        return SourceTask(key, synthetic=source.synthetic, seed=seed, first_nodes=source.first_nodes)
    clean = read[source.title].pack()
    content = {"content": hashlib.sha256(clean).hexdigest(), "first": source.first_nodes, "code": provenance.solving()}
    return SourceTask(provenance.digest(content), clean=clean, first_nodes=source.first_nodes)


def _world_task(source: SourceConfig, setting: SettingConfig, seed: int) -> SourceTask:
    overrides = {**source.overrides, **setting.overrides, "seed": seed}
    config = Config.load(source.config or source.world, overrides, overridden_by=f"{source.title}: overrides")
    backends = config.backends.model_copy(update={"names": config.backends.names[:1]})  # the others leave no trace in a graph
    tree = config.model_copy(update={"backends": backends}).model_dump(mode="json")
    identity = {"world": source.world, "config": tree, "window": [source.start_s, source.end_s], "first": source.first_nodes}
    key = provenance.digest({**identity, "code": [provenance.mapping(), provenance.solving()]})
    return SourceTask(key, source.world, tree, source.start_s, source.end_s, first_nodes=source.first_nodes)


def read_source(source: SourceConfig) -> Frozen:
    """Read a graph file or the graph of a session; its reference is the session's truth, where there is one.

    Raises:
        GraphError, StoreError, StreamError: the file or folder is missing or damaged.
    """
    if source.graph is not None:
        graph = read_graph(source.graph)
        graph.validate()
        return Frozen(graph, _unknown(graph))
    assert source.session is not None
    return _read_session(source.session)


def _read_session(path: Path) -> Frozen:
    from hybridmap.store import MapStore, SessionFolder
    from hybridmap.trajectory import read_tum

    folder = SessionFolder(path)
    folder.require()
    with MapStore.open(path) as store:
        experiences = store.map()
    graph = experiences.pose_graph()
    graph.validate()
    if not folder.groundtruth.is_file():
        return Frozen(graph, _unknown(graph))
    stamps = np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64)
    return Frozen(graph, _truth_at(read_tum(folder.groundtruth), stamps), of_truth=True)


def prepare(task: SourceTask) -> SourceResult:
    """Do what a task says: map the world, or make or take the graph, and find its reference. An error is a frozen failure."""
    try:
        frozen = _with_reference(_cut(_made(task), task.first_nodes))
    except HybridMapError as error:
        frozen = Frozen(None, np.zeros((0, 3)), failure=" ".join(str(error).split()))
    return SourceResult(frozen.pack(), provenance.solving())


def _made(task: SourceTask) -> Frozen:
    if task.world is not None:
        return _mapped(task)
    if task.synthetic is not None:
        return laps(task.synthetic, np.random.default_rng(task.seed))
    assert task.clean is not None
    return Frozen.unpack(task.clean)


def _mapped(task: SourceTask) -> Frozen:
    """Drive through the world once and freeze the accepted edges; the truth is known."""
    from hybridmap.mapper import Mapper
    from hybridmap.streams import open_stream

    assert task.world is not None
    assert task.config is not None
    config = Config.from_tree(task.config, "study")
    stream = open_stream(task.world, config, start_s=task.start_s, end_s=task.end_s)
    mapper = Mapper(config, stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    graph = mapper.map.pose_graph()
    if not graph.n_edges or stream.groundtruth is None:
        raise StudyError(f"{task.world}: the drive gave {graph.n_nodes} nodes and no edge; drive longer (end_s)")
    stamps = np.array([node.stamp_ns for node in mapper.map.nodes], dtype=np.int64)
    return Frozen(graph, _truth_at(stream.groundtruth, stamps), of_truth=True)


def laps(config: SyntheticConfig, rng: np.random.Generator) -> Frozen:
    """A drive round and round with white noise on every measurement; node k sees node k - per_lap again."""
    step = np.array([config.step_m, 0.0, 2.0 * np.pi / config.per_lap])
    truth = np.zeros((config.nodes, 3))
    for k in range(1, config.nodes):
        truth[k] = compose(truth[k - 1], step)
    newer = np.arange(1, config.nodes)
    again = np.arange(config.per_lap, config.nodes)
    sources = np.concatenate([newer - 1, again])
    targets = np.concatenate([newer, again - config.per_lap])
    loop = np.arange(len(sources)) >= len(newer)
    order = np.lexsort((loop, np.maximum(sources, targets)))
    sources, targets, loop = sources[order], targets[order], loop[order]
    sigma = np.array([config.translation_m, config.translation_m, config.rotation_rad])
    deltas = compose(between(truth[sources], truth[targets]), exp(rng.standard_normal((len(sources), 3)) * sigma))
    graph = PoseGraph(
        initial=truth,
        sources=sources.astype(np.int64),
        targets=targets.astype(np.int64),
        deltas=deltas,
        information=np.repeat(np.diag(sigma**-2.0)[None], len(sources), axis=0),
        kinds=np.where(loop, EdgeKind.LOOP, EdgeKind.ODOMETRY).astype(np.int8),
        edge_ids=np.arange(len(sources), dtype=np.int64),
    )
    return Frozen(chain(graph), truth, of_truth=True)


def _cut(frozen: Frozen, first_nodes: int | None) -> Frozen:
    if first_nodes is None or frozen.graph is None or first_nodes >= frozen.graph.n_nodes:
        return frozen
    return replace(frozen, graph=prefix(frozen.graph, first_nodes), reference=frozen.reference[:first_nodes])


def _with_reference(frozen: Frozen) -> Frozen:
    """Where no truth is known: the optimum of the clean graph, if there is one to be found."""
    if frozen.of_truth or frozen.graph is None:
        return frozen
    solution = create(LEAST_SQUARES).solve(frozen.graph)
    found = solution.report.status in (SolveStatus.CONVERGED, SolveStatus.MAX_ITERATIONS)
    return replace(frozen, reference=solution.poses) if found else frozen


def _truth_at(truth: Trajectory, stamps_ns: Any) -> Array:
    from hybridmap.evaluate.association import known_at

    poses = truth.at(stamps_ns)
    poses[~known_at(truth, stamps_ns)] = np.nan
    return poses


def _unknown(graph: PoseGraph) -> Array:
    return np.full((graph.n_nodes, 3), np.nan)
