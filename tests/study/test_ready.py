"""A ready study on a real graph, in small."""

import pytest

from hybridmap.study import StudyConfig
from hybridmap.study.pools import ThisProcess
from hybridmap.study.study import run_study


@pytest.mark.data
def test_false_loops_on_intel_ruin_least_squares_and_not_gnc(data_dir, monkeypatch, tmp_path):
    monkeypatch.setenv("HYBRIDMAP_DATA", str(data_dir))
    changes = {"seeds": [0], "false_loops": {"rates": [0.1], "kinds": ["random"]}, "backends": ["gtsam-lm", "gtsam-gnc"]}
    study = StudyConfig.load("false-loops", changes)
    source = study.sources[0].model_copy(update={"first_nodes": 500})
    done = run_study(study.model_copy(update={"sources": (source,)}), tmp_path, ThisProcess())
    ate = {cell.backend: result.figures["ate_m"] for cell, result in done.rows}
    assert ate["gtsam-gnc"] < 0.05
    assert ate["gtsam-lm"] > 1.0
