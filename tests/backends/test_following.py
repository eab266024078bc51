"""Following a graph while it grows: cheap when nothing closes, equal to a whole solve in the end, exact after a failure."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap import backends
from hybridmap.backends.base import SolveStatus
from hybridmap.backends.gtsam.incremental import Smoother
from hybridmap.backends.objective import chi2
from hybridmap.config.backends import BackendsConfig, Isam2Config
from hybridmap.errors import BackendError, GraphError
from hybridmap.geometry import between, compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import difference, prefix
from tests.backends.graphs_for_tests import graph_of, laps

FOLLOWERS = ["gtsam-lm", "gtsam-cauchy", "gtsam-gnc", "gtsam-isam2", "relaxation-ratslam", "relaxation-weighted", "odometry"]


@pytest.mark.parametrize("name", FOLLOWERS)
def test_a_node_on_odometry_alone_is_the_last_pose_and_its_edge(name):
    graph, _ = laps(np.random.default_rng(0), nodes=31)
    backend = backends.create(name)
    before = backend.update(prefix(graph, 20)).poses
    edge = int(np.flatnonzero((graph.sources == 19) & (graph.targets == 20))[0])
    only_odometry = prefix(graph.with_edges(graph.kinds == EdgeKind.ODOMETRY), 21)
    after = backend.update(only_odometry)
    assert np.allclose(after.poses[20], compose(before[19], graph.deltas[edge]), atol=1e-6)


@pytest.mark.parametrize("name", ["gtsam-lm", "gtsam-gn", "gtsam-dogleg", "gtsam-isam2"])
def test_a_replay_ends_at_the_optimum_of_the_whole(name):
    graph, _ = laps(np.random.default_rng(4), nodes=90)
    solutions = list(backends.replay(backends.create(name), graph))
    assert [len(s.poses) for s in solutions] == list(range(1, 91))
    assert solutions[-1].report.chi2 == pytest.approx(backends.create(name).solve(graph).report.chi2, rel=1e-3)
    assert all(np.isfinite(s.poses).all() for s in solutions)


@pytest.mark.parametrize("name", ["gtsam-lm", "gtsam-isam2", "gtsam-cauchy"])
def test_taking_a_false_loop_out_returns_to_the_clean_optimum(name):
    graph, _ = laps(np.random.default_rng(4), nodes=60)
    false = replace(
        graph,
        sources=np.append(graph.sources, 55),
        targets=np.append(graph.targets, 10),
        deltas=np.concatenate([graph.deltas, [[0.2, 0.0, 0.1]]]),
        information=np.concatenate([graph.information, graph.information[:1]]),
        kinds=np.append(graph.kinds, np.int8(EdgeKind.LOOP)),
        edge_ids=np.append(graph.edge_ids, graph.edge_ids[-1] + 1),
    )
    backend = backends.create(name)
    clean = backend.update(graph)
    disturbed = backend.update(false)
    again = backend.update(graph)
    assert np.abs(between(clean.poses, disturbed.poses)).max() > (1e-3 if name != "gtsam-cauchy" else 1e-5)
    assert again.report.chi2 == pytest.approx(clean.report.chi2, rel=1e-2)  # on the way tolerances are loose
    assert np.abs(between(clean.poses, again.poses)).max() < 5e-3


@pytest.mark.parametrize("name", FOLLOWERS)
def test_a_damaged_update_leaves_the_state_before_it(name):
    graph, _ = laps(np.random.default_rng(1), nodes=50)
    undisturbed, backend = backends.create(name), backends.create(name)
    for nodes in (20, 40):
        undisturbed.update(prefix(graph, nodes))
        backend.update(prefix(graph, nodes))
    deltas = graph.deltas.copy()
    deltas[-1, 0] = np.nan
    with pytest.raises(GraphError):
        backend.update(replace(graph, deltas=deltas))
    assert backend.update(graph).poses.tobytes() == undisturbed.update(graph).poses.tobytes()


def test_isam2_recovers_from_an_exception_inside_the_solver(monkeypatch):
    graph, _ = laps(np.random.default_rng(1), nodes=60)
    backend = backends.create("gtsam-isam2")
    kept = backend.update(prefix(graph, 40)).poses

    def fail(*_):
        raise RuntimeError("Indeterminate linear system\nmore words")

    with monkeypatch.context() as broken:
        broken.setattr(Smoother, "follow", fail)
        with pytest.raises(BackendError, match=r"gtsam-isam2: the solver gave up: Indeterminate linear system$"):
            backend.update(prefix(graph, 50))
    repeated = backend.update(prefix(graph, 40)).poses
    assert np.array_equal(repeated, kept)
    best = backends.create("gtsam-lm").solve(graph).report.chi2
    assert backend.update(graph).report.chi2 == pytest.approx(best, rel=1e-2)


def test_what_is_new_and_what_is_gone_is_found_by_number_and_content():
    graph, _ = laps(np.random.default_rng(0), nodes=30)
    assert not difference(graph, graph).closes
    grown = difference(prefix(graph, 15), prefix(graph, 16))
    assert len(grown.added) == 1
    assert not grown.closes
    assert difference(prefix(graph, 25), prefix(graph, 26)).closes
    fewer = difference(graph, graph.with_edges(np.arange(graph.n_edges) != 7))
    assert fewer.removed.tolist() == [7]
    assert fewer.closes
    deltas = graph.deltas.copy()
    deltas[7, 0] += 0.1
    changed = difference(graph, replace(graph, deltas=deltas))
    assert (changed.added.tolist(), changed.removed.tolist(), changed.closes) == ([7], [7], True)


@given(st.integers(0, 10_000), st.integers(1, 6), st.booleans())
@settings(max_examples=60, deadline=None)
def test_the_difference_of_two_states_is_that_of_their_sets_of_edges(seed, changes, reordered):
    rng = np.random.default_rng(seed)
    whole, _ = laps(np.random.default_rng(0), nodes=40)
    if reordered:  # all of the chain before all loops, as in many files: new edges then come in the middle
        whole = replace(whole, edge_ids=np.arange(whole.n_edges))
        order = np.argsort(whole.is_loop, kind="stable")
        whole = replace(whole.with_edges(order), edge_ids=np.arange(whole.n_edges))
    old = prefix(whole, 30).with_edges(rng.random(prefix(whole, 30).n_edges) < rng.choice([0.9, 1.0]))
    new = prefix(whole, 30 + int(rng.integers(0, 8)))
    new = new.with_edges(rng.random(new.n_edges) < rng.choice([0.9, 1.0]))
    deltas, sources = new.deltas.copy(), new.sources.copy()
    for edge in rng.integers(0, new.n_edges, changes).tolist():
        if rng.random() < 0.5:
            deltas[edge, int(rng.integers(3))] += 0.1
        else:
            sources[edge] = (sources[edge] + 1) % 30
    new = replace(new, deltas=deltas, sources=sources)

    def rows(graph):
        return [(int(i), int(s), int(t), d.tobytes(), int(k)) for i, s, t, d, k in fields(graph)]

    def fields(graph):
        return zip(graph.edge_ids, graph.sources, graph.targets, graph.deltas, graph.kinds, strict=True)

    before, after = rows(old), rows(new)
    change = difference(old, new)
    assert [after[i] for i in change.added] == [row for row in after if row not in set(before)]
    assert [before[i] for i in change.removed] == [row for row in before if row not in set(after)]


def test_a_second_chain_edge_of_a_new_node_waits_for_the_next_closure():
    graph, _ = laps(np.random.default_rng(0), nodes=21)
    chain_only = prefix(graph, 18)
    both = replace(
        chain_only,
        sources=np.append(chain_only.sources, 15),
        targets=np.append(chain_only.targets, 17),
        deltas=np.concatenate([chain_only.deltas, [compose(graph.deltas[15], graph.deltas[16])]]),
        information=np.concatenate([chain_only.information, graph.information[:1]]),
        kinds=np.append(chain_only.kinds, np.int8(EdgeKind.REGISTRATION)),
        edge_ids=np.append(chain_only.edge_ids, 999),
    )
    assert not difference(prefix(graph, 17), both).closes


def twice_measured(nodes=20):
    """A chain of odometry with a registration beside each edge, which say different things; no loop."""
    truth = [np.zeros(3)]
    for _ in range(nodes - 1):
        truth.append(compose(truth[-1], [0.5, 0.05, 0.1]))
    pairs = [(k - 1, k, kind) for k in range(1, nodes) for kind in (EdgeKind.ODOMETRY, EdgeKind.REGISTRATION)]
    return graph_of(np.array(truth), pairs, np.random.default_rng(0))


@pytest.mark.parametrize("name", [name for name in backends.names() if name.startswith("gtsam")])
def test_what_waits_for_a_closure_is_not_called_converged_and_counts_at_the_end_of_the_drive(name):
    graph = twice_measured()
    backend = backends.create(name)
    *_, last = backends.replay(backend, graph)
    assert last.report.status is SolveStatus.WAITING
    assert "19 edges waiting for a loop closure" in last.report.message
    end, whole = backend.finish(graph), backends.create(name).solve(graph)
    assert end.report.status is SolveStatus.CONVERGED
    assert end.report.chi2 < 0.9 * last.report.chi2
    assert end.report.chi2 == pytest.approx(whole.report.chi2, rel=1e-6)


def test_odometry_waits_for_nothing():
    *_, last = backends.replay(backends.create("odometry"), twice_measured())
    assert last.report.status is SolveStatus.CONVERGED


def test_a_loop_committed_late_is_replayed_late():
    graph, _ = laps(np.random.default_rng(0), nodes=40)
    entered = graph.entry_nodes.copy()
    late = int(np.flatnonzero(graph.is_loop)[0])
    entered[late] = 35
    dated = replace(graph, entered=entered)
    assert graph.edge_ids[late] not in prefix(dated, 35).edge_ids
    assert graph.edge_ids[late] in prefix(dated, 36).edge_ids


def test_a_graph_that_shrinks_is_refused():
    graph, _ = laps(np.random.default_rng(0), nodes=30)
    backend = backends.create("gtsam-lm")
    backend.update(graph)
    with pytest.raises(BackendError, match="shrank from 30 to 20"):
        backend.update(prefix(graph, 20))


def test_the_end_of_a_drive_is_no_worse_than_the_drive():
    graph, _ = laps(np.random.default_rng(6), nodes=45)
    for name in backends.names():
        backend = backends.create(name)
        *_, last = backends.replay(backend, graph)
        assert backend.finish(graph).report.chi2 <= last.report.chi2 * 1.01, name


def test_isam2_takes_a_kernel_on_loops_when_told_so():
    graph, _ = laps(np.random.default_rng(4), nodes=60)
    config = BackendsConfig(isam2=Isam2Config(loop_kernel="cauchy"))
    robust = backends.create("gtsam-isam2", config).solve(graph)
    assert set(robust.report.weights) == set(graph.edge_ids[graph.is_loop].tolist())
    assert robust.report.chi2 >= chi2(graph, backends.create("gtsam-lm").solve(graph).poses)


def test_odometry_stays_odometry_where_registrations_know_better():
    graph, _ = laps(np.random.default_rng(0), nodes=12)
    chain_kinds = graph.kinds.copy()
    chain_kinds[4:] = EdgeKind.REGISTRATION  # odometry edges from node 4 on were dropped
    deltas = graph.deltas.copy()
    deltas[4:, 0] += 0.3
    refined = replace(graph, kinds=chain_kinds, deltas=deltas)
    assert np.allclose(backends.create("odometry").solve(refined).poses, graph.initial)
    *_, last = backends.replay(backends.create("odometry"), refined)
    assert np.allclose(last.poses, graph.initial)
