"""The bars of the main job, on real recordings and on one simulated drive in four forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridmap import session
from hybridmap.cli.choose import choose
from hybridmap.evaluate import evaluate_session
from hybridmap.geometry import between
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.writers import write_rosbag1, write_rosbag2, write_tum
from hybridmap.store import MapStore

pytestmark = pytest.mark.slow


@pytest.mark.data
@pytest.mark.parametrize(
    ("recording", "all_m", "loops_m"),
    [("fr079/fr079.mcap", 0.048, 0.070), ("aces/aces.bag", 0.040, 0.060)],
    ids=["fr079", "aces"],
)
def test_real_wheels_and_laser_with_no_other_option(data_dir: Path, tmp_path: Path, recording, all_m, loops_m):
    source = data_dir / "real" / recording
    if not source.is_file():
        pytest.skip(f"{source} is not here")
    chosen = choose(str(source), None, {})
    finished = session.run(chosen.stream, chosen.config, tmp_path / "s")
    figures = {m.name: m.value for m in evaluate_session(tmp_path / "s", relations=source.parent / "relations.txt")}
    primary = finished.head["primary_backend"]
    assert figures[f"relation_trans_mean/{primary}"] <= all_m
    assert figures[f"relation_loop_trans_mean/{primary}"] <= loops_m
    with MapStore.open(tmp_path / "s") as store:
        edges, solution = store.map().edges, store.solutions()[primary]
    loops = {n: e for n, e in enumerate(edges) if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED}
    off = {n: between(e.relative.delta, between(*solution.poses[[e.source, e.target]])) for n, e in loops.items() if e.relative}
    wrong = [n for n, error in off.items() if np.hypot(error[0], error[1]) > 1.0]
    assert len(wrong) <= 0.01 * len(loops)
    assert all(solution.report.weights[n] <= 0.5 for n in wrong)


def test_one_drive_live_and_from_three_kinds_of_recording_gives_one_graph(tmp_path: Path):
    overrides = {"simulation.duration_s": 40.0}
    live = choose("office", None, overrides)
    stream = SimulatedStream(live.config.simulation, live.config.seed)
    write_rosbag1(stream, tmp_path / "office.bag")
    write_rosbag2(stream, tmp_path / "office.mcap", storage="mcap")
    write_tum(stream, tmp_path / "office_tum")
    hashes = {"live": session.run(live.stream, live.config, tmp_path / "live").head["graph_hash"]}
    for name in ("office.bag", "office.mcap", "office_tum"):
        chosen = choose(str(tmp_path / name), "office", overrides)
        hashes[name] = session.run(chosen.stream, chosen.config, tmp_path / f"s_{name}").head["graph_hash"]
    assert len(set(hashes.values())) == 1, hashes
