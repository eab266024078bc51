"""The benchmark of matching: what it compares gives the same answers, and its table is whole."""

from __future__ import annotations

import json

import bench_matching
import numpy as np
import pytest

from hybridmap.vision.search import ProfileIndex


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setattr(bench_matching, "best_of", lambda work, seconds=0.0: (work(), 1.0)[1])
    return bench_matching


def test_the_baseline_finds_the_same_views(bench):
    rng = np.random.default_rng(0)
    stored = bench.views(300, 4, rng)
    index = ProfileIndex(np.full(4, 0.25), bench.WIDTH, bench.MAX_SHIFT)
    for profile in stored:
        index.add(profile)
    for near in range(0, 300, 60):
        query = stored[near] + rng.normal(scale=0.2, size=stored[near].shape).astype(np.float32)
        assert bench.plain(query, stored)[0] == index.nearest(query, 1).numbers[0] == near


def test_the_gate_holds_as_many_nodes_in_a_large_map(bench):
    near = [bench.measure(size, 1, 0)["in the gate"] for size in (2000, 4000)]
    assert near[0] == near[1] > 20


def test_the_table_is_whole(bench, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["bench_matching.py", "--sizes", "200", "400", "--numpy-up-to", "200", "--json"])
    bench.main()
    shown = {metric["name"]: metric for metric in json.loads(capsys.readouterr().out)["metrics"]}
    judged = {name for name, metric in shown.items() if "bar" in metric}
    ratios = {"search_over_bare", "numpy_over_search", "gated_against_the_smallest"}
    assert {f"{ratio}/200" for ratio in ratios} <= judged
    assert shown["search_over_bare/200"]["passed"] is True
    assert shown["numpy_over_search/200"]["passed"] is False
    assert "numpy/400" not in shown
    monkeypatch.setattr("sys.argv", ["bench_matching.py", "--sizes", "200"])
    bench.main()
    assert "search / bare" in capsys.readouterr().out
