"""Optimise a pose graph with GTSAM alone. `hybridmap optimize --backend gtsam-lm` is measured against this.

    python tools/bare_gtsam.py GRAPH.g2o

The script reads a planar g2o file and runs Levenberg-Marquardt with GTSAM's defaults, from the poses in the file. It prints
chi2 and the CPU time of the optimisation, without the time to read the file. It does not import hybridmap.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

Edges = list[tuple[int, int, list[float], NDArray[np.float64]]]


def parse(path: Path) -> tuple[dict[int, list[float]], Edges]:
    """Read a g2o file. Return the poses by vertex, and (source, target, delta, information) of each edge."""
    poses: dict[int, list[float]] = {}
    edges: Edges = []
    for line in path.read_text(encoding="utf-8").splitlines():
        tag, *fields = line.split()
        if tag == "VERTEX_SE2":
            poses[int(fields[0])] = [float(field) for field in fields[1:4]]
        elif tag == "EDGE_SE2":
            numbers = [float(field) for field in fields[2:]]
            information = np.zeros((3, 3))
            information[np.triu_indices(3)] = numbers[3:9]
            information = information + np.triu(information, 1).T
            edges.append((int(fields[0]), int(fields[1]), numbers[:3], information))
    return poses, edges


def optimise(poses: dict[int, list[float]], edges: Edges) -> tuple[NDArray[np.float64], float]:
    """Optimise a graph. Return the poses (N, 3) and chi2."""
    graph = gtsam.NonlinearFactorGraph()
    for source, target, delta, information in edges:
        noise = gtsam.noiseModel.Gaussian.Information(information)
        graph.add(gtsam.BetweenFactorPose2(source, target, gtsam.Pose2(*delta), noise))
    first = min(poses)
    graph.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(*poses[first]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
    initial = gtsam.Values()
    for key, pose in poses.items():
        initial.insert(key, gtsam.Pose2(*pose))
    result = gtsam.LevenbergMarquardtOptimizer(graph, initial, gtsam.LevenbergMarquardtParams()).optimize()
    return gtsam.utilities.extractPose2(result), 2.0 * graph.error(result)


def main() -> None:
    """Optimise the file given on the command line."""
    poses, edges = parse(Path(sys.argv[1]))
    started = time.process_time()
    _, chi2 = optimise(poses, edges)
    print(f"chi2 {chi2:.7g}, {time.process_time() - started:.3f} s of CPU")


if __name__ == "__main__":
    main()
