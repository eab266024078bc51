"""One cell: what is disturbed, solved and judged, and that a failure is a result."""

from functools import partial

import numpy as np
import pytest

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.gtsam import batch
from hybridmap.errors import BackendError
from hybridmap.geometry import between, compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.study import cell as cells
from hybridmap.study.cells import lay_out
from hybridmap.study.drive import MappedDrive
from hybridmap.study.false_loops import with_drift, with_false_loops
from hybridmap.study.frozen import Frozen
from hybridmap.study.model import DriftConfig, SyntheticConfig
from hybridmap.study.sources import SourceTask, laps, prepare
from tests.narrowing import known
from tests.study.studies import small


@pytest.fixture(scope="module")
def frozen():
    return laps(SyntheticConfig(nodes=40, per_lap=16), 3)


def figures_of(frozen, **changes):
    """Backend and kind -> result of the cells of a study on one graph."""
    grid = lay_out(small(seeds=[3], **changes))
    return {(cell.backend, cell.kind): cells.run(grid.task(cell, frozen.pack())) for cell in grid.cells}


def test_a_packed_graph_is_the_same_afterwards(frozen):
    again = Frozen.unpack(frozen.pack())
    assert again.pack() == frozen.pack()
    assert np.array_equal(known(again.graph).deltas, frozen.graph.deltas)
    assert known(again.graph).entered is None
    assert again.of_truth


def test_figures_say_what_became_of_true_and_false_loops(frozen):
    found = figures_of(frozen, backends=["gtsam-lm", "odometry", "gtsam-gnc"])
    lm, gnc, odometry = (found[name, "random"].figures for name in ("gtsam-lm", "gtsam-gnc", "odometry"))
    assert lm["own_loops"] == 24
    assert lm["false_loops"] == 10  # 30 % of all
    assert (lm["false_kept"], lm["own_lost"]) == (10, 0)
    assert (odometry["false_kept"], odometry["own_lost"]) == (0, 24)
    assert gnc["false_kept"] <= 1
    assert gnc["own_lost"] <= 1
    assert gnc["ate_m"] < odometry["ate_m"] < lm["ate_m"]
    assert gnc["chi2_own"] < lm["chi2_own"]
    clean = found["gtsam-lm", ""].figures
    assert clean["chi2"] == clean["chi2_own"] < clean["chi2_initial"]


def test_errors_are_those_after_alignment_where_the_truth_is_known():
    truth = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    moved = compose([3.0, -2.0, 1.0], truth)
    assert cells.errors(moved, truth) == pytest.approx((0.0, 0.0), abs=1e-9)
    turned = truth + np.array([0.0, 0.0, np.radians(2.0)])
    assert cells.errors(turned, truth) == pytest.approx((0.0, 2.0), abs=1e-9)
    truth[2:] = np.nan
    assert np.isnan(cells.errors(moved, truth)).all()


def test_a_typed_error_and_divergence_are_results_without_a_map(frozen, monkeypatch):
    def fail(*_):
        raise BackendError("gtsam-lm: had a\nbad day")

    monkeypatch.setattr(batch, "best_start", fail)
    found = figures_of(frozen, backends=["gtsam-lm"])["gtsam-lm", "random"]
    assert (found.status, found.message) == ("failed", "gtsam-lm: had a bad day")
    assert "ate_m" not in found.figures
    assert found.figures["false_loops"] == 10

    def diverge(_method, _factors, start, _max_iterations):
        return Outcome(start, SolveStatus.DIVERGED, "away", 1)

    monkeypatch.setattr(batch, "best_start", lambda _, start: start)
    monkeypatch.setattr(batch, "run", diverge)
    found = figures_of(frozen, backends=["gtsam-lm"])["gtsam-lm", ""]
    assert (found.status, found.message) == ("diverged", "away")
    assert not {"ate_m", "chi2", "own_lost"} & set(found.figures)


def test_every_start_and_way_solves_the_same_problem(frozen):
    starts = [{"name": start, "backend": "gtsam-lm", "start": start} for start in ("odometry", "chain", "angular", "reference")]
    ways = [{"name": way, "backend": "gtsam-isam2", "way": way} for way in ("replay", "drive")]
    found = figures_of(frozen, backends=["gtsam-lm", *starts, *ways], false_loops={})
    chi2 = {name: result.figures["chi2"] for (name, _), result in found.items()}
    for name, value in chi2.items():
        assert value == pytest.approx(chi2["gtsam-lm"], rel=1e-3), name
    initial = {name: result.figures["chi2_initial"] for (name, _), result in found.items()}
    assert initial["odometry"] == pytest.approx(initial["gtsam-lm"])  # the graph's own start is the chain
    assert initial["angular"] < 0.5 * initial["odometry"]
    assert initial["reference"] < 0.5 * initial["odometry"]
    assert found["replay", ""].figures["iterations"] > found["gtsam-lm", ""].figures["iterations"]


def test_drift_bends_the_odometry_and_nothing_else(frozen):
    graph = frozen.graph
    bent = with_drift(graph, DriftConfig(heading_bias_deg_per_m=2.0, scale_bias=0.1), seed=0)
    odometry = graph.kinds == EdgeKind.ODOMETRY
    assert np.array_equal(bent.deltas[~odometry], graph.deltas[~odometry])
    length = np.hypot(*graph.deltas[odometry, :2].T)
    assert bent.deltas[odometry, 2] - graph.deltas[odometry, 2] == pytest.approx(np.radians(2.0) * length)
    assert np.hypot(*bent.deltas[odometry, :2].T) == pytest.approx(1.1 * length)
    turned = np.unwrap(bent.initial[:, 2])[-1] - np.unwrap(graph.initial[:, 2])[-1]
    assert turned == pytest.approx(np.radians(2.0) * length.sum())
    assert with_drift(graph, DriftConfig(), 0) is graph
    noisy = [with_drift(graph, DriftConfig(noise=1.0), seed).deltas for seed in (1, 1, 2)]
    assert np.array_equal(noisy[0], noisy[1])
    assert not np.array_equal(noisy[0], noisy[2])
    assert np.std(noisy[0][odometry] - graph.deltas[odometry], axis=0) == pytest.approx([0.03, 0.03, 0.01], rel=0.4)


def test_drop_outs_are_of_the_seed_and_move_the_way_after_them(frozen):
    graph = frozen.graph
    once, again, other = (with_drift(graph, DriftConfig(dropouts=0.1), seed) for seed in (1, 1, 2))
    assert np.array_equal(once.deltas, again.deltas)
    assert not np.array_equal(once.deltas, other.deltas)
    hit = (once.deltas != graph.deltas).any(axis=1)
    odometry = graph.kinds == EdgeKind.ODOMETRY
    assert hit.sum() == round(0.1 * odometry.sum())
    assert not (hit & ~odometry).any()
    first = int(graph.targets[hit].min())
    assert np.allclose(once.initial[:first], graph.initial[:first])
    assert np.allclose(between(once.initial[first - 1], once.initial[first]), once.deltas[hit][0])


def test_the_same_seed_gives_every_back_end_the_same_false_loops(frozen):
    ends = [with_false_loops(frozen.graph, "random", 0.3, seed).sources for seed in (1, 1, 2)]
    assert np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])
    assert with_false_loops(frozen.graph, "random", 0.0, 1) is frozen.graph


def test_without_truth_the_reference_is_the_clean_optimum(frozen):
    unknown = Frozen(frozen.graph, np.full((40, 3), np.nan))
    made = Frozen.unpack(prepare(SourceTask("key", partial(Frozen.unpack, unknown.pack()))).frozen)
    assert not made.of_truth
    assert figures_of(made, backends=["gtsam-lm"])["gtsam-lm", ""].figures["ate_m"] < 1e-6
    kept = Frozen.unpack(prepare(SourceTask("key", partial(Frozen.unpack, frozen.pack()), first_nodes=30)).frozen)
    assert np.array_equal(kept.reference, frozen.reference[:30])
    assert known(kept.graph).n_nodes == 30


def test_a_source_that_cannot_be_had_is_a_status_of_its_cells():
    result = prepare(SourceTask("key", MappedDrive("lab", {"nodes": {"distance_m": -1.0}}).make))
    failed = Frozen.unpack(result.frozen)
    assert failed.graph is None
    found = figures_of(failed, backends=["gtsam-lm"])["gtsam-lm", "random"]
    assert found.status == "unmapped"
    assert "distance_m" in found.message


def test_a_world_is_mapped_with_its_truth():
    study = small(
        seeds=[0],
        sources=[{"simulated": "lab", "end_s": 2.5, "overrides": {"simulation.camera": {"width_px": 64, "height_px": 48}}}],
        backends=["odometry"],
        false_loops={},
    )
    grid = lay_out(study)
    (task,) = grid.sources.values()
    made = Frozen.unpack(prepare(task).frozen)
    assert made.failure == ""
    assert made.of_truth
    assert known(made.graph).n_nodes == len(made.reference) >= 3
    assert 0.0 < known(cells.run(grid.task(grid.cells[0], made.pack())).figures["ate_m"]) < 0.2
