"""One cell: what is disturbed, solved and judged, and that a failure is a result."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.gtsam import batch, gnc, robust
from hybridmap.backends.registry import names, takes_start
from hybridmap.backends.relaxation import ratslam
from hybridmap.errors import BackendError, ConfigError
from hybridmap.geometry import between, compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.study import cell as cells
from hybridmap.study.cells import lay_out
from hybridmap.study.drive import MappedDrive
from hybridmap.study.false_loops import with_drift, with_false_loops
from hybridmap.study.frozen import Frozen, Mapped
from hybridmap.study.measures import OF_ODOMETRY
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


def test_a_packed_drive_keeps_its_figures_and_its_poses(frozen):
    poses, lost = {"odometry": frozen.reference + 0.1}, {"gtsam-gnc": ("failed", "a bad day")}
    drive = Mapped("gtsam-gnc", {"odometry": {"ate_m": 0.5}}, {"cpu_s": 1.0}, poses, lost)
    again = known(Frozen.unpack(replace(frozen, mapped=drive).pack()).mapped)
    assert (again.primary, again.figures, again.timings) == (drive.primary, drive.figures, drive.timings)
    assert again.lost == drive.lost
    assert set(again.poses) == {"odometry"}
    assert np.array_equal(again.poses["odometry"], drive.poses["odometry"])


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


def test_a_back_end_without_a_map_has_the_error_of_odometry(frozen, monkeypatch):
    odometry = figures_of(frozen, backends=["odometry"])["odometry", "random"].figures

    def fail(*_):
        raise BackendError("gtsam-lm: had a\nbad day")

    monkeypatch.setattr(batch, "best_start", fail)
    found = figures_of(frozen, backends=["gtsam-lm"])["gtsam-lm", "random"]
    assert (found.status, found.message, found.lost) == ("failed", "gtsam-lm: had a bad day", True)
    assert {name: found.figures.get(name) for name in OF_ODOMETRY} == {name: odometry.get(name) for name in OF_ODOMETRY}
    assert found.figures["false_loops"] == 10

    for status in (SolveStatus.DIVERGED, SolveStatus.SINGULAR):

        def stop(_method, _factors, start, _max_iterations, status=status):
            return Outcome(start, status, "away", 1)

        monkeypatch.setattr(batch, "best_start", lambda _, start: start)
        monkeypatch.setattr(batch, "run", stop)
        found = figures_of(frozen, backends=["gtsam-lm"])["gtsam-lm", "random"]
        assert (found.status, found.message, found.lost) == (status, "away", True)
        assert {name: found.figures.get(name) for name in OF_ODOMETRY} == {name: odometry.get(name) for name in OF_ODOMETRY}
        assert not {"own_lost", "false_kept"} & set(found.figures)  # it judged no loop


def test_a_graph_that_cannot_be_made_gives_no_back_end_an_error(frozen):
    bare = Frozen(frozen.graph.with_edges(~frozen.graph.is_loop), frozen.reference)
    found = figures_of(bare, backends=["gtsam-lm"])["gtsam-lm", "random"]
    assert (found.status, found.lost, found.figures) == ("failed", False, {})


def test_every_start_and_way_solves_the_same_problem(frozen):
    starts = [
        {"name": start, "backend": "gtsam-lm", "start": start}
        for start in ("graph", "odometry", "chain", "angular", "reference", "replay")
    ]
    ways = [{"name": f"isam2, {way}", "backend": "gtsam-isam2", "way": way} for way in ("replay", "drive")]
    found = figures_of(frozen, backends=["gtsam-lm", *starts, *ways], false_loops={})
    chi2 = {name: result.figures["chi2"] for (name, _), result in found.items()}
    for name, value in chi2.items():
        assert value == pytest.approx(chi2["gtsam-lm"], rel=1e-3), name
    initial = {name: result.figures["chi2_initial"] for (name, _), result in found.items()}
    assert initial["odometry"] == pytest.approx(initial["gtsam-lm"])  # the graph's own start is the chain
    assert initial["graph"] == initial["gtsam-lm"]
    for start in ("angular", "reference", "replay"):
        assert initial[start] < 0.5 * initial["odometry"]
    assert found["isam2, replay", ""].figures["iterations"] > found["gtsam-lm", ""].figures["iterations"]


@pytest.mark.parametrize("name", [name for name in names() if takes_start(name) and name != "odometry"])
def test_a_back_end_begins_where_it_is_told_and_nowhere_else(frozen, monkeypatch, name):
    def elsewhere(*_):
        raise AssertionError("looked for another start")

    for module in (batch, robust, gnc, ratslam):
        for looked in ("best_start", "trusted_start"):
            monkeypatch.setattr(module, looked, elsewhere, raising=False)
    backends = [{"name": start, "backend": name, "start": start} for start in ("odometry", "angular", "replay")]
    found = figures_of(frozen, backends=backends)
    for (start, kind), result in found.items():
        assert result.figures["chi2_initial"] is not None, (start, kind)
        assert result.figures["ate_m"] is not None
    if name != "relaxation-paper":  # which diverges from anywhere
        assert not found["odometry", ""].lost


def test_a_start_that_a_back_end_cannot_take_is_refused():
    with pytest.raises(ConfigError, match=r"gtsam-calibrated: begins at several poses of its own; found angular, expected own"):
        small(backends=[{"backend": "gtsam-calibrated", "start": "angular"}])
    with pytest.raises(ConfigError, match=r"`start: replay` is solved as a whole; found `way: drive`"):
        small(backends=[{"backend": "gtsam-lm", "start": "replay", "way": "drive"}])
    titles = [
        one.title for one in small(backends=[{"backend": "gtsam-calibrated", "start": "own"}], starts=["angular"]).backends
    ]
    assert titles == ["gtsam-calibrated"]


def test_a_relaxation_rule_says_what_theory_says_of_it_and_what_it_does(frozen):
    rules = [
        {"backend": "relaxation-paper", "settings": {"relaxation.theta": 0.2}},
        {"name": "too fast", "backend": "relaxation-paper", "settings": {"relaxation.theta": 0.5}},
        "relaxation-normalised",
        "relaxation-ratslam",
    ]
    found = {name: result for (name, _), result in figures_of(frozen, backends=rules, false_loops={}).items()}
    for name in ("relaxation-paper", "too fast", "relaxation-normalised"):
        figures = found[name].figures
        assert figures["theta_max_measured"] == pytest.approx(figures["theta_max"], rel=0.005)
        assert figures["shrinks_measured"] == pytest.approx(figures["shrinks"], rel=0.001)
    assert found["relaxation-paper"].figures["shrinks"] < 1.0 < found["too fast"].figures["shrinks"]
    assert found["too fast"].status == "diverged"
    assert "theta_max" not in found["relaxation-ratslam"].figures


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
