"""Are drives through one world joined to one map, and never wrongly? Pairs of starts in lab and office, by laser and by camera.

    python tools/sessions_proof.py --out FOLDER [--json] [--worlds lab,office] [--sensors laser,rgbd]
        [--localize lab,office,fr079]

Each pair is two drives of other sensor errors, each mapped alone and then merged. For each it says how far apart they began,
whether they were joined, and the error of the joint map after one alignment of both. A join is wrong if the place of the second
map on the first is wrong by more than 0.5 m or 10 degrees. Controls never saw the same walls: they must stay apart.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time

import numpy as np

from hybridmap.config import Config
from hybridmap.evaluate.relations import relation_errors, relations_of
from hybridmap.evaluate.trajectory_errors import absolute_error
from hybridmap.geometry import align, between, compose, wrap_angle
from hybridmap.session import run
from hybridmap.sessions.joining import merge
from hybridmap.sessions.localizing import localize
from hybridmap.store import MapStore
from hybridmap.store.session_folder import SessionFolder
from hybridmap.streams.open import open_stream
from hybridmap.trajectory import read_tum

DRIVES = {
    "lab": {"A": (0, 30), "B": (2, 34), "D": (12, 45), "E": (20, 52), "F": (34, 66)},
    "office": {"A": (0, 40), "B": (2, 36), "C": (132, 172), "D": (20, 60), "E": (150, 190), "G": (66, 100)},
}
"""Parts of the drive through each world, s from its start."""
PAIRS = {"lab": ("AB", "AF", "AD", "BE", "FE"), "office": ("AB", "AC", "AD", "CE", "DE")}
"""Pairs that saw the same walls. AB of both, AF of lab and AC of office began less than 1.1 m apart with like headings."""
CONTROLS = {"lab": (), "office": ("AG", "CG")}
"""Pairs that saw other walls."""
LOCALISED = {"lab": ("A", "D"), "office": ("A", "C")}
"""Drives whose second one is localised on the map of the first; of fr079 it is the second half on the first."""
HALF_S = 530.0
ATE_MAX_M, WRONG_M, WRONG_DEG = 0.05, 0.5, 10.0
FOUND_MAX_M, ERROR_RATIO = 5.0, 1.2


@dataclass(frozen=True, slots=True)
class Pair:
    """One pair of drives and what became of it."""

    world: str
    sensor: str
    pair: str
    control: bool
    apart_m: float
    turned_deg: float
    joined: bool
    ate_m: float | None
    off_m: float | None
    off_deg: float | None
    wrong: bool
    cpu_s: float

    @property
    def passed(self) -> bool:
        """Whether the pair keeps its bar: a joint map that is right, or none."""
        return not self.wrong and not (self.control and self.joined) and (self.ate_m is None or self.ate_m <= ATE_MAX_M)


def drive(world: str, sensor: str, name: str, out: Path) -> Path:
    """Map one part of a drive, unless that was done before."""
    folder = out / f"{world}-{sensor}-{name}"
    if not (folder / "metrics.json").is_file():
        start_s, end_s = DRIVES[world][name]
        named = {"simulation.world": world, "seed": ord(name), "backends.names": ["gtsam-gnc"], "neural.modules": 0}
        config = Config.load(sensor, named)
        run(open_stream(world, config, start_s=start_s, end_s=end_s), config, folder, overwrite=True)
    return folder


def joined(world: str, sensor: str, pair: str, out: Path) -> Pair:
    """Merge the two drives of a pair, and compare with the truth."""
    parts = [drive(world, sensor, name, out) for name in pair]
    started = process_time()
    done = merge(parts, out / f"{world}-{sensor}-{pair}", overwrite=True)
    cpu_s = process_time() - started
    with MapStore.open(done.folder.path) as store:
        experiences, poses = store.map(), store.solutions()[store.primary].poses
    truth = [read_tum(SessionFolder(part).groundtruth) for part in parts]
    nodes = [list(session) for session in experiences.sessions]
    true = np.concatenate([one.at(experiences.stamps_ns[own]) for one, own in zip(truth, nodes, strict=True)])
    begun = between(true[nodes[0][0]], true[nodes[1][0]])
    ate_m = off_m = off_deg = None
    if done.joined:
        error = compose(align(true, poses), poses) - true
        ate_m = float(np.sqrt(np.mean(error[:, 0] ** 2 + error[:, 1] ** 2)))
        first, second = (align(true[own], poses[own]) for own in nodes)
        middle = poses[nodes[1]].mean(axis=0)
        off = between(compose(first, middle), compose(second, middle))
        off_m, off_deg = float(np.hypot(off[0], off[1])), float(np.rad2deg(abs(wrap_angle(off[2]))))
    wrong = (off_m or 0.0) > WRONG_M or (off_deg or 0.0) > WRONG_DEG
    apart_m, turned = float(np.hypot(begun[0], begun[1])), float(np.rad2deg(abs(wrap_angle(begun[2]))))
    control = pair in CONTROLS[world]
    return Pair(world, sensor, pair, control, apart_m, turned, done.joined, ate_m, off_m, off_deg, wrong, cpu_s)


@dataclass(frozen=True, slots=True)
class Localisation:
    """A drive that was localised on the map of another."""

    source: str
    sensor: str
    found_after_m: float | None
    known: float
    same_hash: bool
    error_m: float | None
    error_alone_m: float

    @property
    def passed(self) -> bool:
        """Whether the map stayed as it is, and the drive was found in time and is as right on it as on its own map."""
        found = self.found_after_m is not None and self.found_after_m <= FOUND_MAX_M
        return self.same_hash and found and self.error_m is not None and self.error_m <= ERROR_RATIO * self.error_alone_m


def localised(source: str, sensor: str, out: Path) -> Localisation:
    """Localise the second of two drives on the map of the first; the errors are after one alignment, or by relations."""
    if source in DRIVES:
        first, second = LOCALISED[source]
        base = drive(source, sensor, first, out)
        named = {"simulation.world": source, "seed": ord(second), "backends.names": ["gtsam-gnc"], "neural.modules": 0}
        config, (start_s, end_s) = Config.load(sensor, named), DRIVES[source][second]
        stream = open_stream(source, config, start_s=start_s, end_s=end_s)
    else:
        recording = Path(os.environ["HYBRIDMAP_DATA"]) / "real" / "fr079"
        config = Config.load("laser", {"backends.names": ["gtsam-gnc"]})
        base, stream = out / "fr079-first", open_stream(str(recording), config, start_s=HALF_S)
        if not (base / "metrics.json").is_file():
            run(open_stream(str(recording), config, end_s=HALF_S), config, base, overwrite=True)
    done = localize(stream, config, base, out / f"{source}-{sensor}-on-map", overwrite=True)
    figures, said = {metric.name: metric.value for metric in done.metrics}, done.head["localized"]
    ways = [
        read_tum(done.folder.trajectory / f"{name}.tum") for name in ("gtsam-gnc", "on_map") if name != "on_map" or done.found
    ]
    if source in DRIVES:
        errors = [absolute_error(way, read_tum(done.folder.groundtruth)).rmse_m for way in ways]
    else:
        relations = relations_of(recording / "relations.txt", read_tum(done.folder.trajectory / "odometry.tum"))
        errors = [relation_errors(way, relations).all.trans_mean_m for way in ways]
    after_m = figures["found_after"] if done.found else None
    same = said["graph_hash_before"] == said["graph_hash_after"]
    return Localisation(source, sensor, after_m, figures["known_on_map"], same, errors[-1] if done.found else None, errors[0])


def main() -> int:
    """Run all pairs; the exit code is 1 if one misses its bar."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the sessions; drives that are there are kept")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--worlds", default="lab,office")
    parser.add_argument("--sensors", default="laser,rgbd")
    parser.add_argument("--localize", default="", help="worlds, and fr079, in which a drive is localised on a map")
    given = parser.parse_args()
    found = []
    for world in filter(None, given.worlds.split(",")):
        for sensor in given.sensors.split(","):
            for pair in (*PAIRS[world], *CONTROLS[world]):
                found.append(joined(world, sensor, pair, given.out))
                if not given.json:
                    print(said(found[-1]), flush=True)
    on_maps = [
        localised(source, sensor, given.out)
        for source in filter(None, given.localize.split(","))
        for sensor in (given.sensors.split(",") if source in DRIVES else ["laser"])
    ]
    near = sum(one.apart_m < 1.1 and one.turned_deg < 20.0 and not one.control for one in found)
    total = {
        "pairs": len(found),
        "near": near,
        "joined": sum(one.joined for one in found),
        "wrong": sum(one.wrong or (one.control and one.joined) for one in found),
        "largest_ate_m": max((one.ate_m for one in found if one.ate_m is not None), default=None),
        "localised": sum(one.passed for one in on_maps),
        "passed": all(one.passed for one in found) and all(one.passed for one in on_maps),
    }
    if given.json:
        print(
            json.dumps({**total, "each": [asdict(one) for one in found], "on_maps": [asdict(one) for one in on_maps]}, indent=2)
        )
    else:
        for one in on_maps:
            print(one)
        print(total)
    return 0 if total["passed"] else 1


def said(one: Pair) -> str:
    """One line about a pair."""
    began = f"began {one.apart_m:5.2f} m and {one.turned_deg:3.0f} deg apart"
    result = "not joined" if one.ate_m is None else f"joined, joint ATE {one.ate_m:.4f} m{', WRONG' if one.wrong else ''}"
    return f"{one.world:7}{one.sensor:6}{one.pair}{' control' if one.control else ''}: {began}; {result}; {one.cpu_s:.1f} s CPU"


if __name__ == "__main__":
    raise SystemExit(main())
