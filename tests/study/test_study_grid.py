"""The grid: which cells there are, and what their keys depend on."""

from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from hybridmap import provenance
from hybridmap.errors import GraphError
from hybridmap.graph.io import write_g2o
from hybridmap.study.cells import lay_out
from hybridmap.study.false_loops import inject
from hybridmap.study.model import SyntheticConfig
from hybridmap.study.sources import laps
from tests.narrowing import known
from tests.study.studies import small


def keys(**changes):
    return [cell.key for cell in lay_out(small(**changes)).cells]


@pytest.fixture
def graph_file(tmp_path):
    graph = known(laps(SyntheticConfig(nodes=30, per_lap=12), 1).graph)
    write_g2o(tmp_path / "graph.g2o", graph, graph.initial)
    return tmp_path / "graph.g2o"


def test_cells_come_in_order_and_without_false_loops_there_is_no_kind():
    cells = lay_out(small()).cells
    assert len(cells) == 2 * 3 * 3 == len({cell.key for cell in cells})
    assert [(cell.kind, cell.rate, cell.seed, cell.backend) for cell in cells[:4]] == [
        ("", 0.0, 3, "gtsam-lm"),
        ("", 0.0, 3, "odometry"),
        ("", 0.0, 3, "relaxed"),
        ("", 0.0, 5, "gtsam-lm"),
    ]
    assert [cell.kind for cell in cells[6::6]] == ["random", "aliased"]


def test_where_nothing_is_left_to_chance_there_is_one_cell_for_all_seeds(graph_file):
    cells = lay_out(small(sources=[{"graph": str(graph_file)}])).cells
    assert [cell.seed for cell in cells] == [None] * 3 + ([3] * 3 + [5] * 3) * 2
    for drift in ({"noise": 1.0}, {"dropouts": 0.1}):
        settings = [{"name": "by chance", "drift": drift}]
        assert lay_out(small(sources=[{"graph": str(graph_file)}], settings=settings)).cells[0].seed == 3


def test_names_are_no_part_of_a_key_and_everything_else_is():
    base = keys()
    assert keys() == base
    assert keys(name="other", description="words", sources=[{"name": "x", "synthetic": {"nodes": 40, "per_lap": 16}}]) == base
    changed: list[dict[str, object]] = [
        {"sources": [{"synthetic": {"nodes": 41, "per_lap": 16}}]},
        {"sources": [{"synthetic": {"nodes": 40, "per_lap": 16}, "first_nodes": 39}]},
        {"seeds": [4, 6]},
        {"settings": [{"name": "default", "drift": {"heading_bias_deg_per_m": 0.1}}]},
        {"settings": [{"name": "default", "drift": {"dropouts": 0.1}}]},
        {"backends": [{"backend": "gtsam-lm", "settings": {"consistency.enabled": True}}]},
        {"backends": [{"backend": "gtsam-lm", "settings": {"max_iterations": 7}}]},
        {"backends": [{"backend": "gtsam-lm", "start": "angular"}]},
        {"backends": ["gtsam-lm"], "starts": ["graph"]},
        {"backends": [{"backend": "gtsam-lm", "way": "replay"}]},
    ]
    for change in changed:
        assert not set(base) & set(keys(**change)), change
    with_other_rates = keys(false_loops={"rates": [0.0, 0.2], "kinds": ["random", "aliased"]})
    assert with_other_rates[:6] == base[:6]
    assert not set(base[6:]) & set(with_other_rates[6:])


def test_other_code_or_libraries_give_other_keys(monkeypatch):
    base = keys()
    monkeypatch.setattr(provenance, "solving", lambda: "of another version")
    assert not set(base) & set(keys())


def test_the_digest_of_the_code_sees_a_changed_solver(monkeypatch, tmp_path):
    package = tmp_path / "hybridmap"
    for name in ("backends/gtsam/gnc.py", "cli/app.py", "vision/look.py"):
        (package / name).parent.mkdir(parents=True)
        (package / name).write_text("1\n")
    monkeypatch.setattr(resources, "files", lambda _: package)

    def digests():
        return provenance.digest_of_code(solving_only=True), provenance.digest_of_code(solving_only=False)

    solving, mapping = digests()
    (package / "cli" / "app.py").write_text("2\n")
    assert digests() == (solving, mapping)
    (package / "vision" / "look.py").write_text("2\n")
    assert digests()[0] == solving
    assert digests()[1] != mapping
    (package / "backends" / "gnc.py").write_text("2\n")
    assert digests()[0] != solving


def test_a_graph_file_enters_by_its_content_not_its_place(graph_file, tmp_path):
    (tmp_path / "copy").mkdir()
    copy = graph_file.rename(tmp_path / "copy" / "other.g2o")
    moved = keys(sources=[{"graph": str(copy)}])
    text = copy.read_text()
    graph_file.write_text(text)
    assert keys(sources=[{"graph": str(graph_file)}]) == moved
    graph_file.write_text(text.replace("EDGE_SE2 0 1 ", "EDGE_SE2 0 1 1", 1))
    assert not set(moved) & set(keys(sources=[{"graph": str(graph_file)}]))


def test_a_world_s_key_depends_on_its_configuration():
    def world(overrides, end_s=5.0):
        study = small(sources=[{"simulated": "lab", "end_s": end_s}], settings=[{"name": "a", "overrides": overrides}])
        return {cell.source_key for cell in lay_out(study).cells}

    base = world({})
    assert len(base) == 2  # a drive for each seed
    assert world({"nodes": {"distance_m": 0.31}}).isdisjoint(base)
    assert world({}, 6.0).isdisjoint(base)
    assert world({"backends.names": ["gtsam-gnc", "odometry"]}) == base  # only the primary can leave a trace in the graph


def test_a_damaged_graph_ends_it_before_anything_is_done(tmp_path):
    (tmp_path / "bad.g2o").write_text("EDGE_SE2 0 1 1 0\n")
    with pytest.raises(GraphError, match=r"bad.g2o:1"):
        lay_out(small(sources=[{"graph": str(tmp_path / "bad.g2o")}]))


def test_no_true_loop_is_taken_for_a_false_one():
    graph = known(laps(SyntheticConfig(nodes=30, per_lap=12), 1).graph)
    more = inject(graph, 0.3, "random", np.random.default_rng(0))
    assert np.array_equal(more.edge_ids[: graph.n_edges], graph.edge_ids)
    assert replace(more, initial=graph.initial).n_edges > graph.n_edges
