"""Are drives through one world joined to one map, and never wrongly? Pairs of starts in lab and office, by laser and by camera.

    python tools/sessions_proof.py --out FOLDER [--json] [--worlds lab,office] [--sensors laser,rgbd]
        [--localize lab,office,fr079] [--orders office]

Each pair is two drives of other sensor errors, each mapped alone and then merged. For each it says how far apart they began,
whether they were joined, and the error of the joint map after one alignment of both; then the joint map is parted, and both
parts are compared with what they were. A join is wrong if the place of the second map on the first is wrong by more than 0.5 m
or 10 degrees. Controls never saw the same walls: they must stay apart. Three drives are merged in six orders, one after the
other. The exit code is 1 if a figure misses its bar.
"""

from __future__ import annotations

import argparse
import json
import os
import sqlite3
from dataclasses import asdict, dataclass
from itertools import permutations
from pathlib import Path
from time import process_time

import numpy as np
from barred import at_least, at_most

from hybridmap.config import Config
from hybridmap.evaluate.relations import relation_errors, relations_of
from hybridmap.evaluate.trajectory_errors import absolute_error
from hybridmap.geometry import align, between, compose, wrap_angle
from hybridmap.metrics import Metric
from hybridmap.session import run
from hybridmap.sessions.editing import remove_session
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
ORDERED = {"lab": "ADF", "office": "ACD"}
"""Drives that are merged in every order."""
ATE_MAX_M, WRONG_M, WRONG_DEG = 0.05, 0.5, 10.0
PAIRS_MIN, NEAR_MIN, NEAR_M, NEAR_DEG = 20, 5, 1.1, 20.0
ORDER_MAX_M = 0.01
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
    parted: bool
    cpu_s: float

    @property
    def near(self) -> bool:
        """Whether the two began near each other, with like headings."""
        return not self.control and self.apart_m < NEAR_M and self.turned_deg < NEAR_DEG


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
    control = pair in CONTROLS[world]
    wrong = (off_m or 0.0) > WRONG_M or (off_deg or 0.0) > WRONG_DEG or (control and done.joined)
    apart_m, turned = float(np.hypot(begun[0], begun[1])), float(np.rad2deg(abs(wrap_angle(begun[2]))))
    back = [remove_session(done.folder.path, 1 - own, out / f"part {own}", overwrite=True).folder.path for own in (0, 1)]
    parted = all(same(*both) for both in zip(back, parts, strict=True))
    return Pair(world, sensor, pair, control, apart_m, turned, done.joined, ate_m, off_m, off_deg, wrong, parted, cpu_s)


def same(one: Path, other: Path) -> bool:
    """Whether two session folders hold the same: every row of the map files, and every byte of the other files."""
    files = [{file.relative_to(folder) for file in folder.rglob("*") if file.is_file()} for folder in (one, other)]
    named = [{file for file in each if file.name not in ("map.db", "report.html")} for each in files]
    alike = named[0] == named[1] and all((one / file).read_bytes() == (other / file).read_bytes() for file in named[0])
    return alike and rows(one) == rows(other)


def rows(folder: Path) -> dict[str, list[tuple[object, ...]]]:
    """All rows of a map file, table by table."""
    with sqlite3.connect(folder / "map.db") as file:
        names = [name for (name,) in file.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
        return {name: sorted(file.execute(f"SELECT * FROM {name}").fetchall()) for name in names}


@dataclass(frozen=True, slots=True)
class Ordered:
    """Three drives that were merged one after the other in an order."""

    world: str
    sensor: str
    order: str
    joined: bool
    off_m: float


def ordered(world: str, sensor: str, out: Path) -> list[Ordered]:
    """Merge three drives in every order; how far a node is from where the first order has it, after one alignment."""
    first: np.ndarray | None = None
    found = []
    for order in permutations(ORDERED[world]):
        parts = [drive(world, sensor, name, out) for name in order]
        two = merge(parts[:2], out / "two", overwrite=True).folder.path
        three = merge([two, parts[2]], out / "three", overwrite=True)
        with MapStore.open(three.folder.path) as store:
            sessions, poses = store.map().sessions, store.solutions()[store.primary].poses
        of = {name: poses[list(nodes)] for name, nodes in zip(order, sessions, strict=True)}
        now = np.concatenate([of[name] for name in sorted(of)])
        first = now if first is None else first
        off = compose(align(first, now), now) - first
        found.append(Ordered(world, sensor, "".join(order), three.joined, float(np.hypot(off[:, 0], off[:, 1]).max())))
    return found


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


def bars_of(pairs: list[Pair], orders: list[Ordered], on_maps: list[Localisation]) -> list[Metric]:
    """Every figure with its bar; those of what was not run are left out."""
    figures = []
    if pairs:
        real = [one for one in pairs if not one.control]
        figures += [
            at_least("pairs", len(real), PAIRS_MIN, "pairs of drives that saw the same walls"),
            at_least("near", sum(one.near for one in real), NEAR_MIN, "of those, begun near each other with like headings"),
            at_most("ate_joint", max((one.ate_m or 0.0 for one in pairs), default=0.0), ATE_MAX_M, "error of a joint map", "m"),
            at_most("wrong", sum(one.wrong for one in pairs), 0, "pairs that were joined wrongly, controls among them"),
            at_most("not_parted", sum(not one.parted for one in pairs), 0, "pairs whose parts did not come back bit for bit"),
        ]
    if orders:
        apart = sum(not one.joined for one in orders)
        figures += [
            at_most("order", max(one.off_m for one in orders), ORDER_MAX_M, "way of a node by the order of merging", "m"),
            at_most("orders_apart", apart, 0, "orders in which three drives are not one map"),
        ]
    for one in on_maps:
        name, missing = f"{one.source}-{one.sensor}", float("inf")
        after_m = missing if one.found_after_m is None else one.found_after_m
        ratio = missing if one.error_m is None else one.error_m / one.error_alone_m
        figures += [
            at_least(f"same_hash/{name}", one.same_hash, 1, "the map stays as it is"),
            at_most(f"found_after/{name}", after_m, FOUND_MAX_M, "travel to where the place was found", "m"),
            at_most(f"error_ratio/{name}", ratio, ERROR_RATIO, "error on the map by that of the drive's own map"),
        ]
    return figures


def main() -> int:
    """Run all pairs, orders and localisations; the exit code is 1 if a figure misses its bar."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the sessions; drives that are there are kept")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--worlds", default="lab,office")
    parser.add_argument("--sensors", default="laser,rgbd")
    parser.add_argument("--localize", default="", help="worlds, and fr079, in which a drive is localised on a map")
    parser.add_argument("--orders", default="", help="worlds in which three drives are merged in every order")
    given = parser.parse_args()
    sensors, pairs, orders = given.sensors.split(","), [], []
    for world in filter(None, given.worlds.split(",")):
        for sensor in sensors:
            for pair in (*PAIRS[world], *CONTROLS[world]):
                pairs.append(joined(world, sensor, pair, given.out))
                if not given.json:
                    print(said(pairs[-1]), flush=True)
    for world in filter(None, given.orders.split(",")):
        orders += [one for sensor in sensors for one in ordered(world, sensor, given.out)]
    on_maps = [
        localised(source, sensor, given.out)
        for source in filter(None, given.localize.split(","))
        for sensor in (sensors if source in DRIVES else ["laser"])
    ]
    bars = bars_of(pairs, orders, on_maps)
    if given.json:
        each = {"pairs": [*map(asdict, pairs)], "orders": [*map(asdict, orders)], "on_maps": [*map(asdict, on_maps)]}
        found = [{**bar.to_json(), "ok": bar.passed} for bar in bars]
        print(json.dumps({"ok": all(bar.passed for bar in bars), "bars": found, **each}, indent=2))
    else:
        for some in (*orders, *on_maps):
            print(some)
        for bar in bars:
            print(f"{'ok' if bar.passed else 'MISSED':7}{bar.name}: {bar.value:.4g} {bar.unit} ({bar.description})")
    return 0 if all(bar.passed for bar in bars) else 1


def said(one: Pair) -> str:
    """One line about a pair."""
    name = f"{one.world:7}{one.sensor:6}{one.pair}{' control' if one.control else ''}"
    began = f"began {one.apart_m:5.2f} m and {one.turned_deg:3.0f} deg apart"
    result = "not joined" if one.ate_m is None else f"joined, joint ATE {one.ate_m:.4f} m{', WRONG' if one.wrong else ''}"
    parted = "parts came back" if one.parted else "parts did NOT come back"
    return f"{name}: {began}; {result}; {parted}; {one.cpu_s:.1f} s CPU"


if __name__ == "__main__":
    raise SystemExit(main())
