"""Ways through known free space, and replay that finds and mends values, against Dijkstra."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from typer.testing import CliRunner

from hybridmap.cli.app import app
from hybridmap.errors import PlanError
from hybridmap.geometry import RelativePose, between
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.graph.gaps import Kidnapping
from hybridmap.plan.free_space import FreeSpace
from hybridmap.plan.links import Cost, Links, links_of
from hybridmap.plan.planner import Planner
from hybridmap.plan.replay import ReplayPlanner
from hybridmap.plan.session import discs, place
from hybridmap.plan.shortening import length_m, shortened
from hybridmap.streams.base import Rig
from tests.store.sessions import LASER, ring_map, write_session

SIDE = 0.05


def random_links(seed: int, n: int = 60) -> Links:
    rng = np.random.default_rng(seed)
    at = rng.uniform(0, 10, (n, 2))
    off = np.hypot(*(at[:, None] - at).T)
    ends = np.argwhere(np.triu(off < 2.2, 1))
    return Links(n, ends.astype(np.int64), off[ends[:, 0], ends[:, 1]])


def exact(links: Links, goal: int, blocked: np.ndarray) -> np.ndarray:
    ends, costs = links.ends[~blocked], links.costs[~blocked]
    matrix = csr_array((costs, (ends[:, 0], ends[:, 1])), shape=(links.n_nodes, links.n_nodes))
    found: np.ndarray = dijkstra(matrix, directed=False, indices=np.array([goal]))
    return found.ravel()


@pytest.mark.parametrize("seed", range(10))
def test_replay_is_exact_and_backs_up_only_what_it_must(seed):
    links, rng = random_links(seed), np.random.default_rng(seed)
    replay, blocked = ReplayPlanner(links), np.zeros(len(links.costs), dtype=bool)
    for goal in (3, 40):
        assert replay.aim({goal: 0.0}) <= links.n_nodes
        np.testing.assert_allclose(replay.values, exact(links, goal, blocked))
    for _ in range(6):
        before, chosen = replay.values, rng.choice(len(blocked), 12, replace=False)
        blocked[chosen] = True
        backups = replay.block(chosen.tolist())
        np.testing.assert_allclose(replay.values, exact(links, 40, blocked))
        assert backups <= 2 * int((replay.values != before).sum())
    start = int(np.argmax(np.where(np.isfinite(replay.values), replay.values, -1.0)))
    way = replay.way(start)
    assert (way[0], way[-1]) == (start, 40)
    assert np.diff(replay.values[way]).max() < 0


def room_with_wall() -> FreeSpace:
    """A room of 4 x 4 m with a wall from its lower side to y = 3 m."""
    room = np.ones((80, 80), dtype=bool)
    room[:60, 38:42] = False
    return FreeSpace(room, np.zeros(2), SIDE, 0.2)


def planner_in(space: FreeSpace, speed_m_s: float | None = None) -> Planner:
    """Nodes that lead round the wall, well off it."""
    poses = np.array([[0.5, 0.5, 0], [0.5, 2.0, 0], [0.6, 3.6, 0], [2.0, 3.8, 0], [3.4, 3.6, 0], [3.5, 2.0, 0], [3.5, 0.5, 0]])
    ends = np.stack([np.arange(6), np.arange(1, 7)], axis=1)
    return Planner(space, poses, Links(7, ends, np.hypot(*(poses[1:, :2] - poses[:-1, :2]).T)), speed_m_s=speed_m_s)


def test_a_way_is_pulled_taut_round_the_end_of_a_wall():
    space, goal = room_with_wall(), np.array([3.5, 0.5])
    planner = planner_in(space)
    plan = planner.plan(np.array([0.5, 0.5, 1.0]), goal)
    best = np.hypot(1.4, 2.5) * 2 + 0.2
    assert best - 1e-6 <= plan.length_m < 1.01 * best
    assert space.sees(plan.poses[:-1, :2], plan.poses[1:, :2]).all()
    assert plan.poses[0].tolist() == [0.5, 0.5, 1.0]
    assert plan.backups == 7
    assert planner.plan(np.array([1.0, 1.0]), goal).backups == 0
    assert length_m(shortened(plan.poses[:, :2], space)) == pytest.approx(plan.length_m, rel=0.005)


def test_where_nobody_drove_a_shorter_way_is_found_all_the_same():
    room = np.ones((80, 80), dtype=bool)
    room[20:60, 38:42] = False  # the nodes lead round the upper end
    space = FreeSpace(room, np.zeros(2), SIDE, 0.2)
    plan = planner_in(space).plan(np.array([0.5, 1.8]), np.array([3.5, 1.8]))
    assert plan.nodes == ()
    assert plan.length_m < 3.5


def test_a_blocked_passage_is_gone_round_or_said():
    room = np.ones((80, 80), dtype=bool)
    room[20:60, 38:42] = False
    planner = planner_in(FreeSpace(room, np.zeros(2), SIDE, 0.2))
    ends = np.array([0.5, 3.0]), np.array([3.5, 3.0])
    assert planner.plan(*ends).poses[:, 1].min() > 2.5
    planner.block(np.array([2.0, 3.5]), 0.5)
    assert planner.plan(*ends).poses[:, 1].min() < 1.0
    planner.block(np.array([2.0, 0.5]), 0.6)
    with pytest.raises(PlanError, match="no way through known free space"):
        planner.plan(*ends)
    with pytest.raises(PlanError, match=r"goal \(2.00, 2.00\): .*no room there"):
        planner.plan(ends[0], np.array([2.0, 2.0]))


def driven_line(kidnapped: list[Kidnapping], cost: Cost) -> Links:
    """Nodes at 0, 1, 4 and 5 m in an open room, driven in 1, 5 and 1 s."""
    experiences = ExperienceMap()
    poses = np.array([[x, 1.0, 0.0] for x in (0.5, 1.5, 4.5, 5.5)])
    stamps_ns = np.array([0, 1, 6, 7]) * 10**9
    for k, pose in enumerate(poses):
        experiences.add_node(Node(int(stamps_ns[k]), pose, np.zeros(1, dtype=np.float32), 0, 0.0), pose)
        if k:
            relative = RelativePose(between(poses[k - 1], pose), np.eye(3))
            experiences.add_edge(Edge(k - 1, k, EdgeKind.ODOMETRY, Status.ACCEPTED, relative))
    space = FreeSpace(np.ones((40, 140), dtype=bool), np.zeros(2), SIDE, 0.2)
    return links_of(experiences.pose_graph(), poses, stamps_ns, space, kidnapped=kidnapped, cost=cost)


def test_by_time_a_link_costs_what_it_took_and_nobody_drove_while_the_robot_was_carried():
    carried = [Kidnapping(1, 2, 3, 3.0, 1.0)]
    assert driven_line([], Cost.LENGTH).costs.tolist() == pytest.approx([1.0, 3.0, 1.0])
    assert driven_line([], Cost.TIME).costs.tolist() == pytest.approx([1.0, 5.0, 1.0])
    assert driven_line(carried, Cost.LENGTH).ends.tolist() == [[0, 1], [2, 3]]


def test_by_time_only_driven_ways_are_known():
    room = np.ones((80, 80), dtype=bool)
    room[20:60, 38:42] = False  # the nodes lead round the upper end
    space, ends = FreeSpace(room, np.zeros(2), SIDE, 0.2), (np.array([0.5, 1.8]), np.array([3.5, 1.8]))
    assert planner_in(space).plan(*ends).nodes == ()
    assert planner_in(space, speed_m_s=1.0).plan(*ends).nodes != ()


def test_straight_ways_do_not_cross_walls():
    space = room_with_wall()
    starts, ends = np.array([[0.5, 0.5], [0.5, 3.5], [0.5, 0.5]]), np.array([[3.5, 0.5], [3.5, 3.5], [5.0, 5.0]])
    assert space.sees(starts, ends).tolist() == [False, True, False]


def test_places_and_discs_are_read():
    poses = np.arange(6.0).reshape(2, 3)
    assert place("1", poses).tolist() == [3.0, 4.0, 5.0]
    np.testing.assert_allclose(place("-1,2.5,180", poses), [-1.0, 2.5, np.pi])
    for text in ("2", "x", "1,2,3,4", "nan,1", "1e308,0", ""):
        with pytest.raises(PlanError):
            place(text, poses)
    assert discs(["1,2,0.5"])[0][1] == 0.5
    for text in ("1,2", "x", "nan,0,1", "0,0,-1"):
        with pytest.raises(PlanError, match="blocked"):
            discs([text])


@pytest.mark.parametrize("by", ["length", "time"])
def test_the_command_plans_on_a_session(tmp_path, by):
    write_session(tmp_path / "s", ring_map(), rig=Rig(laser=LASER))
    done = CliRunner().invoke(app, ["plan", str(tmp_path / "s"), "--from", "0,0", "--to", "20", "--by", by, "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    metrics = {metric["name"]: metric["value"] for metric in said["metrics"]}
    assert metrics["length"] == pytest.approx(4.0, abs=0.1)
    assert metrics["backups"] == 60
    assert np.hypot(*(np.array(said["path"])[-1, :2] - [0.0, 4.0])) < 0.1


def test_the_command_goes_round_what_is_blocked_and_prints_the_way(tmp_path):
    write_session(tmp_path / "s", ring_map(), rig=Rig(laser=LASER))
    words = ["plan", str(tmp_path / "s"), "--from", "0,0", "--to", "0,4"]
    free, blocked = (CliRunner().invoke(app, [*words, *more]) for more in ((), ("--blocked", "0,2,0.5")))
    assert free.exit_code == blocked.exit_code == 0, blocked.output
    ways = [[line.split() for line in done.stdout.partition("heading\n")[2].splitlines()] for done in (free, blocked)]
    assert ways[0] == [["0.00", "0.00", "90"], ["0.00", "4.00", "90"]]
    assert len(ways[1]) > 2
    assert max(abs(float(row[0])) for row in ways[1]) > 0.6
