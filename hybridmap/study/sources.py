"""Turn a source into a frozen graph with a reference. Each kind of source is a function in `KINDS`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from hybridmap import provenance
from hybridmap.backends.base import SolveStatus
from hybridmap.backends.registry import LEAST_SQUARES, create
from hybridmap.config import Config
from hybridmap.errors import HybridMapError, StreamError
from hybridmap.geometry import Array, between, compose, exp
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import PoseGraph, prefix
from hybridmap.study import disturb
from hybridmap.study.drive import MappedDrive, truth_at
from hybridmap.study.frozen import Frozen
from hybridmap.study.model import SettingConfig, SourceConfig, SyntheticConfig

_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class SourceTask:
    """A task that makes a frozen graph with reference poses.

    Attributes:
        key: digest of everything that determines the graph and its reference.
        make: makes the graph, with ground truth if known, or raises a `HybridMapError`; it may be sent to another machine.
        first_nodes: keep only this many nodes of the graph, from its start; None: all.
    """

    key: str
    make: Callable[[], Frozen]
    first_nodes: int | None = None


@dataclass(frozen=True, slots=True)
class SourceResult:
    """The result of a `SourceTask`.

    Attributes:
        frozen: the graph with its reference poses, as bytes of `Frozen.pack`.
        code: digest of the code that made it.
    """

    frozen: bytes
    code: str


@dataclass(frozen=True, slots=True)
class Source:
    """An opened source of a study: its files are read once, when it is opened.

    Attributes:
        task: (setting, seed) -> the task that makes the graph. Raises a ConfigError if the configuration of a drive is invalid.
        by_chance: setting -> whether the graph depends on the seed.
    """

    task: Callable[[SettingConfig, int], SourceTask]
    by_chance: Callable[[SettingConfig], bool]


def prepare(task: SourceTask) -> SourceResult:
    """Run a task: make the graph and find its reference poses.

    Without ground truth the optimum of the clean graph is the reference. A `HybridMapError` becomes a result without a graph.
    """
    try:
        frozen = _with_reference(_cut(task.make(), task.first_nodes))
    except HybridMapError as error:
        frozen = Frozen(None, np.zeros((0, 3)), failure=" ".join(str(error).split()))
    return SourceResult(frozen.pack(), provenance.solving())


def _synthetic(source: SourceConfig, _maps: bool) -> Source:
    config = source.synthetic
    assert config is not None

    def task(_setting: SettingConfig, seed: int) -> SourceTask:
        identity = {"synthetic": config.model_dump(), "seed": seed, "first": source.first_nodes, "code": provenance.solving()}
        return SourceTask(provenance.digest(identity), partial(laps, config, seed), source.first_nodes)

    return Source(task, lambda _: True)


def _known(source: SourceConfig, _maps: bool) -> Source:
    """A graph file, or the graph of a session: it enters by its content, not by its place."""
    clean = (_read_graph(source.graph) if source.graph is not None else _read_session(source.session)).pack()
    content = {"content": hashlib.sha256(clean).hexdigest(), "first": source.first_nodes, "code": provenance.solving()}
    task = SourceTask(provenance.digest(content), partial(Frozen.unpack, clean), source.first_nodes)
    return Source(lambda *_: task, lambda _: False)


def _drive(source: SourceConfig, maps: bool) -> Source:
    """A simulated world or a recording."""
    paths = [path for path in (source.recording, source.reference, source.relations) if path is not None]
    content = [_content(path) for path in paths]

    def task(setting: SettingConfig, seed: int) -> SourceTask:
        overrides = {**source.overrides, **setting.overrides}
        if source.simulated is not None:
            overrides["seed"] = seed
        config = Config.load(
            setting.config or source.config or source.simulated or "laser",
            overrides,
            overridden_by=f"{source.title}: overrides",
        )
        if not maps:  # the other back-ends leave no trace in a graph
            backends = config.backends.model_copy(update={"names": config.backends.names[:1]})
            config = config.model_copy(update={"backends": backends})
        drive = MappedDrive(
            source=str(source.recording or source.simulated),
            config=config.model_dump(mode="json"),
            start_s=source.start_s,
            end_s=source.end_s,
            disturb={name: strength for name, strength in setting.disturb.items() if np.any(strength)},
            seed=seed if disturb.by_chance(setting.disturb) else 0,
            reference=str(source.reference or ""),
            relations=str(source.relations or ""),
        )
        identity = {
            "drive": [source.simulated, content, drive.config, drive.start_s, drive.end_s],
            "disturb": [drive.disturb, drive.seed],
            "first": source.first_nodes,
            "code": [provenance.mapping(), provenance.solving()],
        }
        return SourceTask(provenance.digest(identity), drive.make, source.first_nodes)

    return Source(task, lambda setting: source.simulated is not None or disturb.by_chance(setting.disturb))


KINDS: Mapping[str, Callable[[SourceConfig, bool], Source]] = {
    "simulated": _drive,
    "recording": _drive,
    "session": _known,
    "graph": _known,
    "synthetic": _synthetic,
}
"""Kind of a source -> what opens it, or raises a HybridMapError; the flag: its drive is judged as it was mapped."""


def _content(path: Path) -> str:
    """Digest of a file, or of every file in a folder.

    Raises:
        StreamError: it does not exist.
    """
    if not path.exists():
        raise StreamError(f"{path}: no such file or folder")
    total = hashlib.sha256()
    for file in sorted(entry for entry in path.rglob("*") if entry.is_file()) if path.is_dir() else [path]:
        total.update(os.fsencode(file.relative_to(path)) + b"\0")
        with file.open("rb") as opened:
            while block := opened.read(_BLOCK):
                total.update(block)
    return total.hexdigest()


def _read_graph(path: Path) -> Frozen:
    graph = read_graph(path)
    graph.validate()
    return Frozen(graph, _unknown(graph))


def _read_session(path: Path | None) -> Frozen:
    from hybridmap.store import MapStore, SessionFolder
    from hybridmap.trajectory import read_tum

    assert path is not None
    folder = SessionFolder(path)
    folder.require()
    with MapStore.open(path) as store:
        experiences = store.map()
    graph = experiences.pose_graph()
    graph.validate()
    if not folder.groundtruth.is_file():
        return Frozen(graph, _unknown(graph))
    stamps = np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64)
    return Frozen(graph, truth_at(read_tum(folder.groundtruth), stamps), of_truth=True)


def laps(config: SyntheticConfig, seed: int) -> Frozen:
    """Make a synthetic graph: a drive in circles with noise on every measurement; node k is joined to node k - per_lap.

    The seed is that of the noise. The true poses are the reference; the initial ones are dead reckoning.
    """
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
    noise = np.random.default_rng(seed).standard_normal((len(sources), 3)) * sigma
    deltas = compose(between(truth[sources], truth[targets]), exp(noise))
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
    """Without ground truth, use the optimum of the clean graph as reference, if it can be computed."""
    if frozen.of_truth or frozen.graph is None:
        return frozen
    solution = create(LEAST_SQUARES).solve(frozen.graph)
    found = solution.report.status in (SolveStatus.CONVERGED, SolveStatus.MAX_ITERATIONS)
    return replace(frozen, reference=solution.poses) if found else frozen


def _unknown(graph: PoseGraph) -> Array:
    return np.full((graph.n_nodes, 3), np.nan)
