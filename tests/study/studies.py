"""Small studies, and work for a pool of processes. A process finds its work by name, so the functions stand in a module."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from hybridmap.study.model import StudyConfig

TREE = {
    "name": "small",
    "seeds": [3, 5],
    "sources": [{"name": "laps", "synthetic": {"nodes": 40, "per_lap": 16}}],
    "backends": ["gtsam-lm", "odometry", {"name": "relaxed", "backend": "relaxation-ratslam"}],
    "false_loops": {"rates": [0.0, 0.3], "kinds": ["random", "aliased"]},
}


def small(**changes: object) -> StudyConfig:
    """Make a study of 2 seeds x 3 back-ends x (no, random, aliased false loops) on a synthetic graph."""
    return StudyConfig.from_tree(TREE | changes, "small.yaml", Path.cwd())


def double(number: int) -> int:
    """Work that never fails."""
    return 2 * number


def picky(number: int) -> int:
    """Work that raises an error for the number 3."""
    if number == 3:
        raise ValueError("not this\none")
    return 2 * number


def deadly(task: tuple[int, str]) -> int:
    """Work that kills its process once for each file named `NUMBER-*`. It deletes the file first."""
    number, marks = task
    for mark in sorted(Path(marks).glob(f"{number}-*")):
        mark.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number


def threads(_: int) -> str:
    """Return the limits on threads of the libraries in a worker."""
    return os.environ["OMP_NUM_THREADS"] + os.environ["OPENBLAS_NUM_THREADS"]
