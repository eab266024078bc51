"""The verdict on a map: each kind of reason is found where it holds, at its place, and only there."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.judging import strain
from hybridmap.calibration.clock import ClockOffset, ClockState
from hybridmap.geometry import RelativePose, apart_m, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status, at_least
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.graph.io import read_graph
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.study.false_loops import inject, with_drift
from hybridmap.study.model import DriftConfig, SyntheticConfig
from hybridmap.study.sources import laps
from hybridmap.verdict import KINDS, Facts, Reason, Verdict, reasons_of, verdict_of

SURE, LOOSE = np.diag([0.01**2, 0.01**2, 0.003**2]), np.diag([0.1**2, 0.1**2, 0.05**2])
CARRIED = 30


def drive(laps_driven: int = 2, per_lap: int = 40) -> np.ndarray:
    """(N, 3) poses of a robot that drives in circles, half a metre from node to node."""
    poses = np.zeros((laps_driven * per_lap, 3))
    for node in range(1, len(poses)):
        poses[node] = compose(poses[node - 1], np.array([0.5, 0.0, 2.0 * np.pi / per_lap]))
    return poses


def mapped(truth: np.ndarray, *, registered: bool = True, per_lap: int = 40, slip: np.ndarray | None = None) -> ExperienceMap:
    """A map of exact measurements with a loop to the lap before; `slip` is added to the registrations at node CARRIED."""
    experiences = ExperienceMap()
    for node, pose in enumerate(truth):
        experiences.add_node(Node(node * 1_000_000_000, pose, np.zeros(0, np.float32), -1, 0.5 * node), pose)
        if node == 0:
            continue
        step = between(truth[node - 1], pose)
        if slip is not None and node == CARRIED:
            step = compose(step, slip)
        experiences.add_edge(Edge(node - 1, node, EdgeKind.ODOMETRY, Status.ACCEPTED, RelativePose(step, LOOSE)))
        if registered:
            experiences.add_edge(Edge(node - 1, node, EdgeKind.REGISTRATION, Status.ACCEPTED, RelativePose(step, SURE)))
        if node >= per_lap:
            experiences.add_edge(loop(truth, node - per_lap, node))
    return experiences


def loop(truth: np.ndarray, older: int, newer: int, **more: Any) -> Edge:
    return Edge(older, newer, EdgeKind.LOOP, Status.ACCEPTED, RelativePose(between(truth[older], truth[newer]), SURE), **more)


def judged(experiences: ExperienceMap, backend: str = "gtsam-gnc", **more: Any) -> dict[str, Reason]:
    solution = backends.create(backend).solve(experiences)
    found = reasons_of(Facts.of_drive(experiences, solution, backend, **more))
    return {reason.kind: reason for reason in found}


def test_nothing_speaks_against_a_good_map():
    assert judged(mapped(drive())) == {}
    assert verdict_of([]) is Verdict.TRUSTED


def test_loops_that_lose_against_a_chain_that_was_broken_are_named_with_their_place():
    found = judged(mapped(drive(), slip=np.array([1.0, 0.0, 0.0])))["loops refused"]
    assert found.node == CARRIED
    assert found.count >= 25
    assert found.value == pytest.approx(1.0, abs=0.1)
    assert found.time_s == CARRIED
    assert found.verdict is Verdict.DOUBTFUL


def test_of_the_steps_that_loops_dispute_alike_the_one_that_contradicts_the_wheels_is_named():
    truth = drive()
    experiences = mapped(truth, slip=np.array([1.0, 0.0, 0.0]))
    for number, edge in enumerate(experiences.edges):
        if edge.kind is EdgeKind.ODOMETRY and edge.target == CARRIED + 5:
            off = compose(between(truth[edge.source], truth[edge.target]), np.array([0.3, 0.0, 0.0]))
            experiences.update_edge(number, replace(edge, relative=RelativePose(off, LOOSE)))
    assert judged(experiences)["loops refused"].node == CARRIED + 5
    facts = Facts.of_drive(experiences, backends.create("gtsam-gnc").solve(experiences), "gtsam-gnc")
    assert [one.node for one in reasons_of(replace(facts, steps=None)) if one.kind == "loops refused"] == [CARRIED]


def test_loops_that_left_the_graph_still_speak():
    truth = drive()
    experiences = mapped(truth, slip=np.array([1.0, 0.0, 0.0]))
    for number, edge in enumerate(experiences.edges):
        if edge.kind is EdgeKind.LOOP and edge.source < CARRIED <= edge.target:
            experiences.update_edge(number, replace(edge, status=Status.REJECTED, relative=None, lack=Lack.CONTRADICTED))
    assert judged(experiences)["loops refused"].node == CARRIED


@pytest.mark.parametrize(("share", "speaks"), [(0.45, True), (0.1, False)])
def test_refused_loops_speak_if_they_missed_by_a_hair(share, speaks):
    truth = drive(1)
    experiences = mapped(truth, slip=np.array([0.0, 2.0, 0.0]))
    for older in range(8):
        edge = loop(truth, older, older + CARRIED)
        experiences.add_edge(Edge.decided(older, older + CARRIED, EdgeKind.LOOP, edge.relative, [at_least("near", share, 0.5)]))
    assert ("loops refused" in judged(experiences)) is speaks


def test_small_groups_of_a_drive_speak_together_and_those_of_a_file_do_not():
    truth = drive(2)
    experiences = mapped(truth[:60], slip=np.array([0.0, 2.0, 0.0]), per_lap=60)
    for older in (0, 1, 2, 15, 16, 17):
        relative, checks = loop(truth, older, older + CARRIED).relative, [at_least("near", 0.45, 0.5)]
        experiences.add_edge(Edge.decided(older, older + CARRIED, EdgeKind.LOOP, relative, checks))
    facts = Facts.of_drive(experiences, backends.create("gtsam-gnc").solve(experiences), "gtsam-gnc")
    assert [(reason.kind, reason.count) for reason in reasons_of(facts)] == [("loops refused", 6)]
    assert reasons_of(replace(facts, driven=False)) == ()


def test_false_loops_against_many_true_ones_are_no_reason():
    graph = laps(SyntheticConfig(nodes=240, per_lap=60), 2).graph
    assert graph is not None
    false = inject(graph, 0.4, "aliased", np.random.default_rng(2))
    solution = backends.create("gtsam-gnc").solve(false)
    assert solution.report.rejected_edge_ids
    assert reasons_of(Facts.of_graph(false, solution)) == ()


def test_a_map_that_false_loops_bend_is_doubted():
    graph = laps(SyntheticConfig(nodes=240, per_lap=60), 0).graph
    assert graph is not None
    false = inject(graph, 0.1, "random", np.random.default_rng(0))
    kinds = {reason.kind for reason in reasons_of(Facts.of_graph(false, backends.create("gtsam-lm").solve(false)))}
    assert "bent" in kinds


@pytest.fixture(scope="module")
def clean() -> PoseGraph:
    graph = laps(SyntheticConfig(nodes=240, per_lap=60), 0).graph
    assert graph is not None
    return graph


def kinds_of(graph: PoseGraph, backend: str = "gtsam-lm") -> set[str]:
    return {reason.kind for reason in reasons_of(Facts.of_graph(graph, backends.create(backend).solve(graph)))}


PULLED = DriftConfig(heading_bias_deg_per_m=3.0)


@pytest.mark.parametrize("backend", ["gtsam-lm", "gtsam-calibrated"])
def test_odometry_that_pulls_alike_everywhere_is_no_reason_where_loops_of_either_half_say_so(clean, backend):
    assert kinds_of(with_drift(clean, PULLED, 0), backend) == set()


def test_odometry_that_pulls_is_a_reason_where_one_place_alone_says_so(clean):
    graph = with_drift(clean, PULLED, 0)
    few = np.flatnonzero(graph.is_loop)[-8:]
    assert "bent" in kinds_of(graph.with_edges(np.union1d(np.flatnonzero(graph.is_motion), few)))


def test_odometry_that_pulls_is_a_reason_where_a_half_of_the_loops_finds_numbers_that_no_robot_has(clean, monkeypatch):
    monkeypatch.setattr(strain, "calibrate", lambda *_: (np.array([1.0, 1.0, 5.0]), None))
    assert "bent" in kinds_of(with_drift(clean, PULLED, 0))


def test_odometry_that_errs_by_chance_is_a_reason(clean):
    assert {"bent", "edges contradict"} <= kinds_of(with_drift(clean, DriftConfig(noise=4.0), 0))


@pytest.mark.parametrize("kind", [EdgeKind.ODOMETRY, EdgeKind.LOOP])
def test_odometry_that_pulls_hides_no_wrong_edge(clean, kind):
    graph = with_drift(clean, PULLED, 0)
    deltas, edge = graph.deltas.copy(), np.flatnonzero(graph.kinds == kind)[100]
    deltas[edge] = compose(deltas[edge], np.array([0.0, 3.0, 0.0]))
    assert "bent" in kinds_of(replace(graph, deltas=deltas))


def overstated(graph: PoseGraph) -> PoseGraph:
    """The graph of a file that overstates its noise: nearly all fits."""
    return replace(graph, information=graph.information / 50.0)


def with_loops(graph: PoseGraph, poses: np.ndarray, claims: list[tuple[int, int, float]]) -> PoseGraph:
    """The graph with a loop for each (older node, newer node, m by which it wants the newer one moved along y of the map)."""
    deltas = [between(poses[older], compose(np.array([0.0, off_m, 0.0]), poses[newer])) for older, newer, off_m in claims]
    return replace(
        graph,
        sources=np.append(graph.sources, [older for older, *_ in claims]),
        targets=np.append(graph.targets, [newer for _, newer, _ in claims]),
        deltas=np.vstack([graph.deltas, deltas]),
        information=np.concatenate([graph.information, [graph.information[graph.is_loop][0]] * len(claims)]),
        kinds=np.append(graph.kinds, np.full(len(claims), EdgeKind.LOOP, dtype=np.int8)),
        edge_ids=np.append(graph.edge_ids, graph.edge_ids[-1] + 1 + np.arange(len(claims))),
        entered=None,
    )


@pytest.mark.parametrize(("off_m", "speaks"), [(0.0, False), (3.0, True)])
def test_a_loop_that_no_other_confirms_is_a_reason_if_it_moves_the_map(clean, off_m, speaks):
    noisy = overstated(clean)
    graph = with_loops(noisy, backends.create("gtsam-lm").solve(noisy).poses, [(0, 150, off_m)])
    facts = Facts.of_graph(graph, backends.create("gtsam-lm").solve(graph))
    found = {reason.kind: reason for reason in reasons_of(facts)}
    assert ("loops alone" in found) is speaks
    assert not speaks or (found["loops alone"].node, found["loops alone"].until, found["loops alone"].count) == (0, 150, 1)
    assert "loops alone" not in {reason.kind for reason in reasons_of(replace(facts, driven=True))}


@pytest.mark.parametrize(("other_m", "speaks"), [(3.0, False), (-3.0, True), (4.0, True)])
def test_two_lone_loops_confirm_each_other_if_they_say_the_same(clean, other_m, speaks):
    noisy = overstated(clean)
    graph = with_loops(noisy, backends.create("gtsam-lm").solve(noisy).poses, [(0, 150, 3.0), (12, 162, other_m)])
    assert ("loops alone" in kinds_of(graph)) is speaks


@pytest.mark.parametrize("backend", ["gtsam-lm", "gtsam-gnc"])
@pytest.mark.parametrize("file", ["input_INTEL_g2o.g2o", "FR079_P_toro.graph", "intel.g2o", "CSAIL.g2o"])
def test_clean_public_graphs_are_trusted(file, backend, data_dir):
    assert kinds_of(read_graph(data_dir / "posegraphs" / file), backend) == set()


def test_a_lone_false_loop_in_a_public_graph_is_doubted(data_dir):
    graph = read_graph(data_dir / "posegraphs" / "input_INTEL_g2o.g2o")
    poses = backends.create("gtsam-lm").solve(graph).poses
    assert "loops alone" in kinds_of(with_loops(graph, poses, [(300, 900, 2.0)]))


@pytest.mark.parametrize(("backend", "speaks"), [("gtsam-huber", True), ("gtsam-gnc", False)])
def test_rejected_loops_that_pull_the_map_are_a_reason(clean, backend, speaks):
    false = inject(clean, 0.05, "random", np.random.default_rng(0))
    assert ("pulled" in kinds_of(false, backend)) is speaks


@pytest.mark.parametrize(("seed", "speaks"), [(0, True), (11, False)])
def test_true_loops_that_a_kernel_rejects_are_a_reason_only_if_the_map_is_far_worse_without_them(seed, speaks):
    drive = laps(SyntheticConfig(nodes=240, per_lap=60), seed)
    assert drive.graph is not None
    assert drive.reference is not None
    solution = backends.create("gtsam-dcs").solve(drive.graph)
    assert len(solution.report.rejected_edge_ids) > 40
    assert (apart_m(drive.reference, solution.poses) > 0.2) is speaks
    kinds = {reason.kind for reason in reasons_of(Facts.of_graph(drive.graph, solution))}
    assert kinds == ({"loops refused"} if speaks else set())


def test_a_back_end_that_gave_nothing_has_failed():
    experiences = mapped(drive())
    graph = experiences.pose_graph()
    solution = backends.create("gtsam-lm").solve(graph)
    diverged = Solution(graph.initial, replace(solution.report, status=SolveStatus.DIVERGED))
    for given, failure, kind in (
        (None, "", "back-end failed"),
        (solution, "singular", "back-end failed"),
        (diverged, "", "no map"),
    ):
        (reason,) = reasons_of(Facts.of_drive(experiences, given, "gtsam-lm", failure=failure))
        assert (reason.kind, verdict_of([reason])) == (kind, Verdict.FAILED)


def test_a_back_end_that_stalled_is_doubted():
    experiences = mapped(drive())
    solution = backends.create("gtsam-lm").solve(experiences)
    stalled = replace(solution, report=replace(solution.report, status=SolveStatus.STALLED))
    assert [reason.kind for reason in reasons_of(Facts.of_drive(experiences, stalled, "gtsam-lm"))] == ["fell back"]


def test_poses_that_were_returned_as_they_were_given_are_no_map():
    graph = mapped(drive(), slip=np.array([1.0, 0.0, 0.0])).pose_graph()
    moved = replace(graph, initial=graph.initial + np.array([0.0, 0.0, 0.0]))
    start = Solution(moved.initial, replace(backends.create("gtsam-lm").solve(moved).report, chi2=1e6))
    assert [reason.kind for reason in reasons_of(Facts.of_graph(moved, start)) if reason.verdict is Verdict.FAILED] == [
        "no map"
    ]


def test_dead_reckoning_is_doubted():
    assert judged(mapped(drive()), "odometry")["dead reckoning"].value == 40


def test_a_map_far_from_its_own_optimum_is_doubted():
    graph = mapped(drive()).pose_graph()
    solution = backends.create("gtsam-lm").solve(graph)
    off = Solution(solution.poses * np.array([1.3, 1.0, 1.0]), solution.report)
    found = {reason.kind: reason for reason in reasons_of(Facts.of_graph(graph, off))}
    far = np.abs(solution.poses[:, 0])
    assert far[found["unsettled"].node] == pytest.approx(far.max(), abs=0.01)


def test_edges_that_are_far_too_sure_contradict_each_other():
    graph = laps(SyntheticConfig(nodes=120, per_lap=60), 0).graph
    assert graph is not None
    sure = replace(graph, information=10.0 * graph.information)
    kinds = [reason.kind for reason in reasons_of(Facts.of_graph(sure, backends.create("gtsam-lm").solve(sure)))]
    assert kinds == ["edges contradict"]


def test_a_back_end_that_rejects_all_loops_is_doubted():
    graph = laps(SyntheticConfig(nodes=240, per_lap=60), 0).graph
    assert graph is not None
    worse = with_drift(graph, DriftConfig(noise=9.0), 0)
    found = {reason.kind: reason for reason in reasons_of(Facts.of_graph(worse, backends.create("gtsam-gnc").solve(worse)))}
    assert found["loops rejected"].value >= 160


def test_contradicted_odometry_is_counted():
    experiences = mapped(drive())
    odometry = [number for number, edge in enumerate(experiences.edges) if edge.kind is EdgeKind.ODOMETRY]
    for number in odometry[::2]:
        experiences.update_edge(number, experiences.edge(number).settled(lack=Lack.OVERRULED))
    found = judged(experiences)["odometry dropped"]
    assert (found.count, found.node, found.until) == (40, 1, 79)
    assert found.value == pytest.approx(100.0 * 40 / 79)


@pytest.mark.parametrize(
    ("clock", "left_s"),
    [
        (None, None),
        (ClockOffset(), None),
        (ClockOffset(ClockState.KNOWN, 0.14, 0.003, used_s=0.135), None),
        (ClockOffset(ClockState.KNOWN, 0.14, 0.003), 0.14),
        (ClockOffset(ClockState.TIME_BASE, 4.0), 4.0),
    ],
)
def test_an_offset_of_the_clocks_is_a_reason_unless_it_was_corrected(clock, left_s):
    found = judged(mapped(drive()), clock=clock).get("clock offset")
    assert left_s == (found and found.value)


def test_a_way_on_odometry_alone_is_named_where_no_loop_spans_it():
    held, found = judged(mapped(drive(2), registered=False)), judged(mapped(drive(1), registered=False))
    assert "motion unobserved" not in held
    assert (found["motion unobserved"].node, found["motion unobserved"].until) == (0, 39)
    assert found["motion unobserved"].value == pytest.approx(19.5)


@pytest.mark.parametrize(("breaks", "speaks"), [(2, False), (3, True)])
def test_a_motion_that_is_broken_in_many_places_is_doubted(breaks, speaks):
    experiences = mapped(drive())
    steps = [number for number, edge in enumerate(experiences.edges) if edge.kind is EdgeKind.REGISTRATION][5 : 5 + breaks]
    for number in steps:
        seen = (at_least("seen", 0.0, 1.0),)
        experiences.update_edge(number, replace(experiences.edge(number), broken_by=seen))
    found = judged(experiences)
    assert ("motion broken" in found) is speaks
    assert not speaks or (found["motion broken"].node, found["motion broken"].until) == (6, 5 + breaks)


def test_a_map_against_the_odometry_is_doubted_where_no_loop_decides():
    turned = [np.array([0.5, 0.0, 2.0 * np.pi / 40 + 0.06])] * 39
    experiences = mapped(drive(1))
    for number, edge in enumerate(experiences.edges):
        if edge.kind is EdgeKind.ODOMETRY:
            experiences.update_edge(number, replace(edge, relative=RelativePose(turned[edge.source], LOOSE)))
    found = judged(experiences)["against odometry"]
    assert (found.node, found.until) == (0, 39)


def test_a_few_views_may_be_left_out_for_want_of_time():
    assert "views dropped" not in judged(mapped(drive()), dropped={"scans": (5, 100)})
    reason = judged(mapped(drive()), dropped={"scans": (6, 100)})["views dropped"]
    assert (reason.name, reason.count, reason.value, reason.limit) == ("scans", 6, 6.0, 5.0)


def test_a_robot_that_is_lost_and_messages_that_are_missing():
    found = judged(mapped(drive()), lost_since=70, lost={"/scan": (5, 200)})
    assert (found["not localised"].node, found["not localised"].until) == (70, 79)
    assert (found["messages lost"].name, found["messages lost"].count, found["messages lost"].value) == ("/scan", 5, 2.5)


def test_every_kind_can_be_said_and_written():
    for kind in KINDS:
        reason = Reason(kind, 1.0, 2.0, node=3, until=5, stamp_ns=4_000_000_000, start_ns=1_000_000_000, name="x")
        row = json.loads(json.dumps(reason.to_json()))
        assert (row["kind"], row["node"], row["until_node"], row["time_s"], row["stamp_s"]) == (kind, 3, 5, 3.0, 4.0)
        assert row["words"].startswith("nodes 3 to 5 (3 s): ")
    assert Reason("bent").to_json()["value"] is None


def test_a_graph_has_no_stamps():
    ends = np.array([0]), np.array([1])
    graph = PoseGraph(np.zeros((2, 3)), *ends, np.zeros((1, 3)), np.eye(3)[None], np.zeros(1, np.int8), np.zeros(1, np.int64))
    facts = Facts.of_graph(graph, backends.create("gtsam-lm").solve(graph))
    assert facts.reason("bent", node=1).time_s is None
    assert str(facts.reason("bent", node=1)).startswith("node 1: ")
    assert [reason.kind for reason in reasons_of(facts)] == ["dead reckoning"]  # the one edge is odometry
