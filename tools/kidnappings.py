"""Carry simulated robots over short and long ways, and ask of each map: is it right, or is it doubted at the right node?

    python tools/kidnappings.py [--worlds lab,office] [--sensors laser,rgbd] [--lengths 0,0.3,1] [--seeds 1,2] [--out rows.csv]

A row is a drive. `right`: the error of the map is at most 0.05 m. `named`: the verdict is not `trusted`, and a reason or a
kidnapping that was found names a node within 2 of the carry. `silent`: neither. With length 0 nobody is carried, and `silent`
says whether the map is not `trusted` or a kidnapping is claimed: a false alarm. In a small world a long way ends at the
farthest known place: `carried_m` is the way that it was.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hybridmap.config import Config
from hybridmap.evaluate import evaluate_session
from hybridmap.graph.gaps import kidnappings
from hybridmap.session import run
from hybridmap.simulation import SimulatedStream
from hybridmap.store import MapStore

RIGHT_M, NEAR_NODES = 0.05, 2
LENGTHS_M = "0,0.3,0.5,1,1.5,2,3,20"


def main() -> None:
    """Drive every combination, print a row each, and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="lab,office")
    parser.add_argument("--sensors", default="laser,rgbd")
    parser.add_argument("--lengths", default=LENGTHS_M, help="m; 0: nobody is carried")
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--out", type=Path, help="also write the rows to this CSV file")
    given = parser.parse_args()
    cells = product(given.worlds.split(","), given.sensors.split(","), given.lengths.split(","), given.seeds.split(","))
    rows = []
    for world, sensor, length, seed in cells:
        rows.append(drive(world, sensor, float(length), int(seed)))
        print(" ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
        if given.out is not None:
            write(given.out, rows)
    silent = sum(row["silent"] for row in rows)
    print(f"{len(rows)} drives: {sum(row['right'] for row in rows)} right, {silent} silent or false alarms")
    sys.exit(1 if silent else 0)


def drive(world: str, sensor: str, length_m: float, seed: int) -> dict[str, Any]:
    """Map one drive; returns its row."""
    settings = {"simulation.world": world, "simulation.sensors": sensor, "seed": seed, "backends.names": ["gtsam-gnc"]}
    if length_m > 0.0:
        settings["simulation.carried_m"] = length_m
    config = Config.load(sensor, settings)
    stream = SimulatedStream(config.simulation, seed)
    started = time.process_time()
    with TemporaryDirectory() as folder:
        done = run(stream, config, Path(folder) / "session")
        figures = {metric.name: metric.value for metric in evaluate_session(done.folder.path)}
        with MapStore.open(done.folder.path) as store:
            experiences = store.map()
    carry = stream.carry
    stamps = np.array([node.stamp_ns for node in experiences.nodes])
    node = None if carry is None else int(np.searchsorted(stamps, stream.groundtruth.stamps_ns[carry.last]))
    found = [one.after for one in kidnappings(experiences)]
    doubted = [reason["node"] for reason in done.head["reasons"]]
    error_m = figures["ate_rmse/gtsam-gnc"]
    right, trusted = bool(error_m <= RIGHT_M), done.head["verdict"] == "trusted"
    if node is None:
        named, silent = False, bool(found) or not trusted
    else:
        near = any(named is not None and abs(named - node) <= NEAR_NODES for named in (*found, *doubted))
        named = near and not trusted
        silent = not right and not named
    return {
        "world": world,
        "sensor": sensor,
        "length_m": length_m,
        "seed": seed,
        "carried_m": 0.0 if carry is None else round(carry.distance_m, 2),
        "node": "" if node is None else node,
        "error_m": round(error_m, 4),
        "kidnapped": "/".join(map(str, found)),
        "verdict": done.head["verdict"],
        "reasons": "/".join(f"{reason['kind']}@{reason['node']}" for reason in done.head["reasons"]).replace(" ", "-"),
        "right": right,
        "named": named,
        "silent": silent,
        "cpu_s": round(time.process_time() - started, 1),
    }


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write the rows so far."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
