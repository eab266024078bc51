"""A package of its own adds a back-end and a front-end, and the command line takes both by name."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hybridmap.store import MapStore

ROOT = Path(__file__).resolve().parents[1]

PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "theirs"
version = "1"
[project.entry-points."hybridmap.backends"]
spread = "their_backend:create"
[project.entry-points."hybridmap.front_ends"]
home = "their_front_end:create"
[tool.hatch.build.targets.wheel]
include = ["*.py"]
"""

BACKEND = '''
"""Spreads the error of the newest loop evenly over the positions of the nodes that it spans."""
import numpy as np
from hybridmap import backends
from hybridmap.geometry import compose


def spread(graph, start):
    poses, loops = start.copy(), np.flatnonzero(graph.is_loop)
    if len(loops):
        loop = loops[-1]
        source, target = int(graph.sources[loop]), int(graph.targets[loop])
        error = compose(poses[source], graph.deltas[loop])[:2] - poses[target, :2]
        first, last = min(source, target), max(source, target)
        share = np.clip((np.arange(graph.n_nodes) - first) / (last - first), 0.0, 1.0)[:, None]
        poses[:, :2] += share * error * (1.0 if target > source else -1.0)
    return backends.Outcome(poses, backends.SolveStatus.CONVERGED, f"{len(loops)} loops", 1)


def create(config):
    return backends.Driver("spread", config, spread)
'''

FRONT_END = '''
"""Knows one place: near the node where the drive began it closes a loop."""
import numpy as np
from hybridmap.geometry import RelativePose, between
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.vision.base import View


class Home:
    lost_since = None

    def observe(self, frame, delta_node_robot):
        return View(frame.stamp_ns, np.zeros((1, 8), dtype=np.float32), 0, False)

    def close(self, node, belief):
        apart = between(belief.poses_map_node[node], belief.poses_map_node[0])
        if node < 3 or np.hypot(*apart[:2]) > 2.0:
            return []
        home = RelativePose(apart, np.diag([0.1, 0.1, 0.1]))
        return [Edge(node, 0, EdgeKind.LOOP, Status.ACCEPTED, home, key=node)]

    add_node = track = finish = lambda self, *given: []

    def keyframe(self, node):
        return {"profile": np.zeros((1, 8), dtype=np.float32)}


def create(config, rig, seed, clock):
    return Home()
'''


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A command of `hybridmap` with their package installed beside ours; its JSON object."""
    source, installed = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("installed")
    for name, text in (("pyproject.toml", PROJECT), ("their_backend.py", BACKEND), ("their_front_end.py", FRONT_END)):
        assert len(text.strip().splitlines()) <= 30
        (source / name).write_text(text.lstrip())
    pip = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", installed, source)
    subprocess.run([sys.executable, *map(str, pip)], check=True, capture_output=True, timeout=120)
    path = os.pathsep.join(map(str, (installed, ROOT)))

    def command(*words):
        line = [sys.executable, "-c", "from hybridmap.cli import main; main()", *map(str, words), "--json"]
        env = os.environ | {"PYTHONPATH": path}
        done = subprocess.run(line, cwd=source, env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return command


def test_both_run_in_map_compare_and_study_by_the_names_of_their_entry_points(run, tmp_path):
    session, study = tmp_path / "session", tmp_path / "study.yaml"
    words = ("--backend", "spread", "--set", "vision.sensor=home", "--end", "12", "--out", session)
    assert run("map", "lab", "--config", "laser", *words)["backends"] == ["spread"]
    with MapStore.open(session) as store:
        loops = store.map().pose_graph().is_loop
        assert store.solutions()["spread"].report.message == f"{loops.sum()} loops"
    assert loops.any()
    told = run("compare", session, "--backends", "odometry,spread")
    assert told["status"]["spread"] == "converged"
    study.write_text(
        "sources: [{simulated: lab, config: laser, end_s: 12}]\n"
        "settings: [{name: home, overrides: {vision.sensor: home}}]\n"
        "backends: [odometry, spread]\n"
    )
    run("study", study, "--out", tmp_path / "cells")
    assert "spread" in (tmp_path / "cells" / "report.html").read_text()
