"""A session from a map that another mapper made: its graph, solved by the configured back-ends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.backends import objective
from hybridmap.backends.base import ODOMETRY, SolveReport, SolveStatus
from hybridmap.backends.ensemble import Ensemble
from hybridmap.config import Config
from hybridmap.errors import StreamError
from hybridmap.geometry import IDENTITY, Array, RelativePose, compose_relative
from hybridmap.graph.edges import Edge, EdgeKind, Method
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.graph.io import graph_hash
from hybridmap.graph.paths import odometry_covariance
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.imported.ratslam_bag import read_bag
from hybridmap.imported.recorded import RecordedMap, made_by
from hybridmap.imported.tables import read_tables
from hybridmap.metrics import Metric, StageClock, figure
from hybridmap.neural.pose_cells import CELL_RAD
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.store.schema import DURATION_S, RATSLAM_ACTIONS
from hybridmap.streams.base import Rig
from hybridmap.streams.open import kind_of
from hybridmap.trajectory import NS_PER_S
from hybridmap.verdict import Facts, reasons_of, said_of

RECORDED = "openratslam"
"""Name under which a session keeps the poses of the experiences on the recorded map, beside the solutions of back-ends."""
TAKEN = "a ROS 1 bag (.bag), a ROS 2 bag (folder with metadata.yaml, .mcap, .db3), or a table NAME_nodes.csv or NAME_links.csv"
"""What can be imported."""
_SIGMA_RAD = 0.5 * CELL_RAD


def import_map(source: Path, config: Config, out: Path, *, overwrite: bool = False) -> SessionFolder:
    """Make a session of a recorded experience map, in a bag or as tables.

    Covariances are a choice, as the maps have none: see `experience_map`.

    Args:
        source: a bag, or one of the tables NAME_nodes.csv and NAME_links.csv.
        config: back-ends, noise of odometry edges, topic of the odometry.
        out: the session folder itself.
        overwrite: replace a session that exists.

    Raises:
        StreamError: the source is missing or damaged, or holds no such map.
        GraphError: its links are no map.
        BackendError: a back-end does not exist.
        OutputError: the folder cannot be used.
    """
    kind = kind_of(source, TAKEN)
    if kind == "TUM RGB-D folder":
        raise StreamError(f"{source}: a {kind}; expected {TAKEN}")
    recorded = read_tables(source) if source.suffix.lower() == ".csv" else read_bag(source, config.sensors)
    clock = StageClock()
    backends = Ensemble(config.backends, clock)
    experiences = experience_map(recorded, config, str(source))
    graph = experiences.pose_graph()
    backends.finish(graph)
    folder = SessionFolder(out)
    with folder.writing(overwrite=overwrite):
        folder.write_config(config.to_yaml())
        with MapStore.create(out, config.to_yaml(), Rig(), recorded.name) as store:
            _store(store, recorded, experiences)
            folder.write_trajectory(ODOMETRY, recorded.track.odometry)
            figures: list[Metric] = []
            for name, solution in _solutions(backends, recorded, graph).items():
                store.put_solution(name, *solution)
                if name != ODOMETRY:
                    folder.write_trajectory(name, trajectory_of(recorded.track, solution[0]))
                figures += _figures_of(graph, name, *solution)
            head = _head(recorded, experiences, backends)
            folder.write_metrics(head, [*_figures(recorded, experiences), *figures, *_times(clock)])
            for key in ("graph_hash", "primary_backend"):
                store.put_info(key, head[key])
    return folder


def experience_map(recorded: RecordedMap, config: Config, where: str) -> ExperienceMap:
    """The nodes and edges of a recorded map.

    The link that made an experience is an odometry edge, every other one a loop. The covariance of a link is that of odometry
    over its way (section `edges` of the configuration). Where the robot was taken to be in an experience that it knew, at the
    end of a loop or at the start of a link from another experience than the newest, a match is added: half the median length
    of the odometry edges, as experiences lie about a cell apart, and half of OpenRatSLAM's 10 deg of a heading cell. A link of
    a recorded map has one at its start in any case: it was measured from an experience that was relaxed meanwhile.

    Raises:
        GraphError: the links are no map.
    """
    makers = set(made_by(recorded.links, len(recorded.stamps_ns), where))
    lengths = [np.hypot(*link.delta[:2]) for number, link in enumerate(recorded.links) if number in makers]
    sigma_m = max(0.5 * float(np.median(lengths)) if lengths else 0.0, config.edges.translation_floor_m)
    match = RelativePose(IDENTITY, np.diag([sigma_m**2, sigma_m**2, _SIGMA_RAD**2]))
    experiences, newest = ExperienceMap(), 0
    for number, stamp_ns in enumerate(recorded.stamps_ns.tolist()):
        code, pose = np.zeros(0, dtype=np.float32), recorded.poses_odom[number]
        travel_m, template = float(recorded.travel_m[number]), int(recorded.templates[number])
        experiences.add_node(Node(stamp_ns, pose, code, template, travel_m), pose)
    for number, link in enumerate(recorded.links):
        relative = RelativePose(link.delta, odometry_covariance(config.edges, link.travel_m, link.turn_rad))
        if link.source != newest or recorded.poses is not None:
            relative = compose_relative(match, relative)
        if number not in makers:
            relative = compose_relative(relative, match)
        kind = EdgeKind.ODOMETRY if number in makers else EdgeKind.LOOP
        newest = max(newest, link.source, link.target)
        more: dict[str, Any] = {"method": Method.ODOMETRY, "figures": {DURATION_S: link.duration_s}, "since_node": newest}
        experiences.add_edge(Edge.decided(link.source, link.target, kind, relative, **more))
    return experiences


def _store(store: MapStore, recorded: RecordedMap, experiences: ExperienceMap) -> None:
    for number, (node, initial) in enumerate(zip(experiences.nodes, experiences.initial, strict=True)):
        store.add_node(number, node, initial, {}, {})
    for number, edge in enumerate(experiences.edges):
        store.put_edge(number, edge)
    track = recorded.track
    for row in zip(track.stamps_ns.tolist(), track.nodes.tolist(), track.deltas, track.poses_odom, strict=True):
        store.add_track(*row)
    if recorded.actions:
        store.put_info(RATSLAM_ACTIONS, recorded.actions)


def _solutions(backends: Ensemble, recorded: RecordedMap, graph: PoseGraph) -> dict[str, tuple[Array, SolveReport]]:
    """Poses and report by name: of every back-end that has them, and of the recorded map."""
    found = {name: (one.poses, one.report) for name, one in backends.solutions.items()}
    if recorded.poses is not None:
        costs = objective.chi2(graph, graph.initial), objective.chi2(graph, recorded.poses)
        found[RECORDED] = recorded.poses, SolveReport(RECORDED, SolveStatus.CONVERGED, "as recorded", 0, *costs, 0.0)
    return found


def _head(recorded: RecordedMap, experiences: ExperienceMap, backends: Ensemble) -> dict[str, Any]:
    primary = backends.primary
    failure = backends.failures.get(primary, "")
    facts = Facts.of_drive(experiences, backends.solutions.get(primary), primary, failure=failure)
    facts = replace(facts, driven=False)  # nothing is known of how the loops were found
    return {
        **said_of(reasons_of(facts)),
        "graph_hash": graph_hash(experiences),
        "primary_backend": primary,
        "backends": [*backends.names, *([] if recorded.poses is None else [RECORDED])],
        "titles": {},
        "source": recorded.name,
        "failed_backends": dict(backends.failures),
        "stream": recorded.counts,
        "lost": {},
        "remarks": list(recorded.remarks),
    }


def _figures(recorded: RecordedMap, experiences: ExperienceMap) -> list[Metric]:
    stamps_ns, graph = recorded.track.stamps_ns, experiences.pose_graph()
    chain = objective.chi2(graph, graph.initial)
    return [
        figure("nodes", len(experiences)),
        figure("loops_accepted", float(graph.is_loop.sum())),
        figure("travel", float(recorded.travel_m[-1])),
        figure("duration", float(stamps_ns[-1] - stamps_ns[0]) / NS_PER_S),
        figure(f"chi2_initial/{ODOMETRY}", chain),
        figure(f"chi2/{ODOMETRY}", chain),
    ]


def _figures_of(graph: PoseGraph, name: str, poses: Array, report: SolveReport) -> list[Metric]:
    if name == ODOMETRY:
        return []
    return [
        figure(f"chi2_initial/{name}", objective.chi2(graph, graph.initial)),
        figure(f"chi2/{name}", objective.chi2(graph, poses)),
        figure(f"loops_rejected/{name}", len(report.rejected_edge_ids)),
    ]


def _times(clock: StageClock) -> list[Metric]:
    return [figure(f"cpu_s/{stage}", cpu_s, what="the stage") for stage, cpu_s in clock.cpu_s.items()]
