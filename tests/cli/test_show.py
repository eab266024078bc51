from __future__ import annotations

import math

from hybridmap.cli.show import emit
from hybridmap.metrics import Metric


def test_tables_show_counts_as_whole_numbers_and_figures_with_four_digits(capsys):
    plain = [
        Metric("poses", 13880.0, "1", "many"),
        Metric("size/grid", 312448.0, "1", "more"),
        Metric("none", math.nan, "m", ""),
    ]
    by_backend = [Metric("ate_poses/odometry", 49240.0, "1", "poses"), Metric("ate_rmse/odometry", 0.123456, "m", "error")]
    emit({"backends": ["odometry"]}, [*plain, *by_backend], as_json=False)
    rows = [[cell.strip() for cell in line.strip("│ ").split("│")] for line in capsys.readouterr().out.splitlines()]
    found = {row[0]: row[1:] for row in rows}
    assert found["poses"][0] == "13880"
    assert found["size/grid"][0] == "312448"
    assert found["none"][0] == "–"
    assert found["ate_poses"] == ["1", "49240"]
    assert found["ate_rmse"] == ["m", "0.1235"]


def test_what_happened_on_the_way_stands_under_the_tables(capsys):
    head = {"remarks": ["carried between nodes 3 and 4: [here]"]}
    emit(head, [Metric("nodes", 12.0, "1", "made")], as_json=False)
    assert capsys.readouterr().out.splitlines()[-1] == "note: carried between nodes 3 and 4: [here]"


def test_the_verdict_is_the_last_line(capsys):
    head = {"verdict": "doubtful", "reasons": [{"words": "node 3 (1 s): bent [here]"}], "remarks": ["a note"]}
    emit(head, [Metric("nodes", 12.0, "1", "made")], as_json=False)
    assert capsys.readouterr().out.splitlines()[-3:] == [
        "note: a note",
        "reason: node 3 (1 s): bent [here]",
        "verdict: doubtful",
    ]
