"""The kinds of files that `mutate.py` spoils: how valid ones are made, how they are spoilt, and which commands read them."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mutations
import numpy as np
from mutations import BINARY, TEXT, Spoil

OUT = "out"
Arguments = list[str]
Rng = np.random.Generator


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        seed: writes valid files into a folder.
        spoil: (folder with them, generator) spoils one of them; returns what was done.
        commands: (folder, generator) the commands that read them, run in that folder.
    """

    seed: Callable[[Path], None]
    spoil: Callable[[Path, Rng], str]
    commands: Callable[[Path, Rng], list[Arguments]]


# ---------------------------------------------------------------------- valid files


def valid_of(folder: Path) -> Path:
    """The folder with the valid files of the case in a folder: they lie beside all cases."""
    return folder.parents[1] / "valid"


def hybridmap(*arguments: str) -> int:
    """Run one command in this process; returns its exit code."""
    from hybridmap.cli import main

    sys.argv = ["hybridmap", *arguments]
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


_SMALL = ("--set", "simulation.camera.width_px=48", "--set", "simulation.camera.height_px=36")


def _drive(name: str, sensors: str, duration_s: float) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        settings = ("--set", f"simulation.sensors={sensors}", "--set", "simulation.laser.beams=60", *_SMALL)
        hybridmap("simulate", "lab", "--out", str(folder / name), "--duration", str(duration_s), *settings, "--json")

    return write


def _bags(suffix: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        _drive(f"laser.{suffix}", "laser", 2.0)(folder)
        _drive(f"rgbd.{suffix}", "rgbd", 1.0)(folder)

    return write


def _pictures(folder: Path) -> None:
    _drive("tum", "rgbd", 1.0)(folder)
    _drive("rgbd.mcap", "rgbd", 1.0)(folder)
    _compress(folder / "rgbd.mcap", folder / "compressed.mcap")


def _csv(folder: Path) -> None:
    rows = (f"{1700000000 + 0.1 * k:.2f},{0.5:.2f},{0.2 * np.sin(k / 9):.4f}" for k in range(40))
    (folder / "drive.csv").write_text("\n".join(["stamp_s,v_m_s,omega_rad_s", *rows]) + "\n")
    poses = (f"{1700000000 + 0.1 * k:.2f} {0.05 * k:.3f} 0 0 0 0 0 1" for k in range(40))
    (folder / "drive_groundtruth.tum").write_text("\n".join(poses) + "\n")


def _graphs(folder: Path) -> None:
    from hybridmap.graph.io import write_g2o
    from hybridmap.study.model import SyntheticConfig
    from hybridmap.study.sources import laps

    graph = laps(SyntheticConfig(nodes=16, per_lap=6), 0).graph
    assert graph is not None
    write_g2o(folder / "a.g2o", graph, graph.initial)
    rows = (folder / "a.g2o").read_text().replace("VERTEX_SE2", "VERTEX2").replace("EDGE_SE2", "EDGE2").splitlines()
    swapped = [_toro(row.split(" ")) if row.startswith("EDGE2") else row for row in rows]
    (folder / "a.toro").write_text("\n".join(swapped) + "\n")
    (folder / "edges.g2o").write_text(
        "\n".join(row for row in (folder / "a.g2o").read_text().splitlines() if "EDGE" in row) + "\n"
    )


def _toro(fields: list[str]) -> str:
    xx, xy, xt, yy, yt, tt = fields[6:]
    return " ".join([*fields[:6], xx, xy, yy, tt, xt, yt])


def _configurations(folder: Path) -> None:
    from hybridmap.config import Config

    _drive("laser.mcap", "laser", 1.0)(folder)
    (folder / "all.yaml").write_text(Config.load("laser").to_yaml())
    (folder / "short.yaml").write_text("extends: all.yaml\nnodes:\n  distance_m: 0.3\nvision: {sensor: laser}\n")


_STUDY = """
name: a study
description: what $x$ does
seeds: 2
sources:
  - {name: laps, synthetic: {nodes: 12, per_lap: 5, step_m: 0.5, translation_m: 0.03, rotation_rad: 0.01}}
  - {name: file, graph: a.g2o, first_nodes: 10}
settings:
  - {name: clean}
  - {name: bent, drift: {heading_bias_deg_per_m: 1.0, scale_bias: 0.01, noise: 0.5, dropouts: 0.1}}
backends:
  - {backend: odometry, start: chain}
  - {name: plain, backend: gtsam-lm, way: solve, start: graph, settings: {max_iterations: 20}}
false_loops: {rates: [0.0, 0.2], kinds: [random]}
statistics: {confidence: 0.9, method: bootstrap, resamples: 100}
bars:
  - {figure: ate_m, at_most: 5.0, backends: plain, statistic: median}
"""


def _studies(folder: Path) -> None:
    _graphs(folder)
    (folder / "study.yaml").write_text(_STUDY)


def _sessions(folder: Path) -> None:
    _drive("laser.mcap", "laser", 12.0)(folder)
    hybridmap("map", str(folder / "laser.mcap"), "--out", str(folder / "session"), "--json")
    _drive("rgbd.mcap", "rgbd", 2.0)(folder)
    hybridmap("map", str(folder / "rgbd.mcap"), "--out", str(folder / "rgbd"), "--json")
    (folder / "laser.mcap").unlink()
    (folder / "rgbd.mcap").unlink()
    (folder / "relations.txt").write_text("1700000001.0 1700000003.0 0.9 0 0\n")


# ---------------------------------------------------------------------- what is spoilt


def _one_of(things: Any, rng: Rng) -> Any:
    return things[int(rng.integers(len(things)))]


def _files(*patterns: str, ways: tuple[Spoil, ...]) -> Callable[[Path, Rng], str]:
    """Spoil the content of one of the files, once in a while its name."""

    def spoil(folder: Path, rng: Rng) -> str:
        found = sorted(path for pattern in patterns for path in folder.glob(pattern) if path.is_file())
        path = _one_of(found, rng)
        if rng.random() < 0.02:
            return _renamed(path)
        way = _one_of(ways, rng)
        path.write_bytes(way(path.read_bytes(), rng))
        return f"{path.relative_to(folder)}: {way.__name__}"

    return spoil


def _renamed(path: Path) -> str:
    """A name that is not UTF-8."""
    name = os.fsdecode(os.fsencode(path.stem) + b"\xff\xe9" + os.fsencode(path.suffix))
    path.rename(path.with_name(name))
    return f"{path.name}: renamed"


def _either(*ways: Callable[[Path, Rng], str]) -> Callable[[Path, Rng], str]:
    return lambda folder, rng: str(_one_of(ways, rng)(folder, rng))


@cache
def _messages(path: Path) -> list[tuple[str, str, int, bytes]]:
    """Topic, type, time and bytes of every message of a valid bag."""
    if path.suffix == ".bag":
        from rosbags.rosbag1 import Reader as Reader1

        with Reader1(path) as reader:
            return [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages()]
    from rosbags.rosbag2 import Reader as Reader2

    with Reader2(path) as reader2:
        return [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader2.messages()]


def _write(path: Path, messages: list[tuple[str, str, int, bytes]]) -> None:
    """Write the messages as a bag."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    path.unlink(missing_ok=True)
    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        from rosbags.rosbag1 import Writer

        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        opened, place = Writer(path), path
    else:
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        place = path.with_name("bag")
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        opened = Writer2(place, version=8, storage_plugin=plugin)
    with opened as writer:
        known: dict[str, Any] = {}
        for topic, msgtype, time_ns, data in messages:
            if topic not in known:
                known[topic] = writer.add_connection(topic, msgtype, typestore=store)
            writer.write(known[topic], time_ns, data)
    if not is_ros1:
        next(place.glob(f"*{path.suffix}")).rename(path)
        shutil.rmtree(place)


def _in_messages(*names: str, topics: str = "") -> Callable[[Path, Rng], str]:
    """Spoil the content of a message, or of every message of its topic in the same way."""

    def spoil(folder: Path, rng: Rng) -> str:
        name = _one_of(names, rng)
        messages = list(_messages(valid_of(folder) / name))
        of_kind = [k for k, message in enumerate(messages) if topics in message[0]]
        chosen = _one_of(of_kind, rng)
        topic = messages[chosen][0] if rng.random() < 0.8 else _one_of(sorted({messages[k][0] for k in of_kind}), rng)
        alike = [k for k, message in enumerate(messages) if message[0] == topic]
        everywhere, seed = rng.random() < 0.4, int(rng.integers(1 << 30))
        way = _one_of((*BINARY, _restamped), rng)
        for k in alike if everywhere else [_one_of(alike, rng)]:
            of, msgtype, time_ns, data = messages[k]
            messages[k] = of, msgtype, time_ns, way(data, np.random.default_rng(seed))
        _write(folder / name, messages)
        return f"{name}: {topic}: {way.__name__}{' of all' if everywhere else ''}"

    return spoil


def _restamped(data: bytes, rng: Rng) -> bytes:
    """Another stamp in the header: far off, or milliseconds or nanoseconds for seconds."""
    seconds: int = _one_of((0, 1, 2**31 - 1, 2**32 - 1, 1_700_000_001, 86_400), rng)
    nanoseconds: int = _one_of((0, 999_999_999, 2**32 - 1, 2**31), rng)
    return data[:4] + seconds.to_bytes(4, "little") + nanoseconds.to_bytes(4, "little") + data[12:]


def _compress(source: Path, target: Path) -> None:
    """The bag with compressed pictures."""
    import cv2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    compressed = store.types["sensor_msgs/msg/CompressedImage"]
    messages = []
    for topic, msgtype, time_ns, data in _messages(source):
        if msgtype != "sensor_msgs/msg/Image":
            messages.append((topic, msgtype, time_ns, data))
            continue
        image = store.deserialize_cdr(data, msgtype)
        depth = "depth" in topic
        pixels = np.frombuffer(image.data.tobytes(), np.uint16 if depth else np.uint8).reshape(image.height, image.width, -1)
        suffix = ".png" if depth else ".jpg"
        packed = compressed(header=image.header, format=suffix[1:], data=cv2.imencode(suffix, pixels)[1].ravel())
        kind = "sensor_msgs/msg/CompressedImage"
        messages.append((f"{topic}/compressed", kind, time_ns, bytes(store.serialize_cdr(packed, kind))))
    _write(target, messages)


_SIZES = (0, 1, 47, 49, 20_000, 65_535, 1_000_000, 2**31 - 1, 2**32 - 1)


def lying(data: bytes, rng: Rng) -> bytes:
    """A PNG or JPEG whose header says another size, depth or kind than its data have; the checksum is right."""
    import zlib

    if data[:4] == b"\x89PNG":
        header = bytearray(data[16:29])
        if rng.random() < 0.6:
            at = int(rng.choice((0, 4)))
            header[at : at + 4] = int(_one_of(_SIZES, rng)).to_bytes(4, "big")
        else:
            header[8:10] = bytes([_one_of((1, 2, 4, 8, 16), rng), _one_of((0, 2, 3, 4, 6), rng)])
        return data[:16] + header + zlib.crc32(b"IHDR" + header).to_bytes(4, "big") + data[33:]
    at = data.find(b"\xff\xc0")
    size = b"".join(int(_one_of((0, 1, 36, 48, 20_000, 65_535), rng)).to_bytes(2, "big") for _ in range(2))
    return data[: at + 5] + size + data[at + 9 :]


def _in_map(folder: Path, rng: Rng) -> str:
    """Spoil the tables or the bytes of a map file."""
    path = folder / _one_of(("session", "session", "rgbd"), rng) / "map.db"
    if rng.random() < 0.75:
        mutations.table(path, rng)
        return f"{path.parent.name}/map.db: table"
    way = _one_of(BINARY, rng)
    path.write_bytes(way(path.read_bytes(), rng))
    return f"{path.parent.name}/map.db: {way.__name__}"


# ---------------------------------------------------------------------- what reads it


def _reading(folder: Path, rng: Rng) -> list[Arguments]:
    """Commands for the recording that was spoilt."""
    changed = [path for path in _sources(folder) if _content(path) != _content(valid_of(folder) / path.name)]
    source = str((changed or _sources(folder))[0].relative_to(folder))
    look = ["inspect", source] if rng.random() < 0.5 else ["inspect", source, "--json"]
    options = [["--skip-damaged"], ["--strict"], []][int(rng.integers(3))] if _knows_options() else []
    return [look, ["map", source, "--out", OUT, "--end", "5", *options]]


@cache
def _knows_options() -> bool:
    from hybridmap.cli.map import map_source

    return "skip_damaged" in map_source.__annotations__


def _sources(folder: Path) -> list[Path]:
    kinds = (".bag", ".mcap", ".db3", ".csv")
    return sorted(path for path in folder.iterdir() if path.suffix in kinds or (path / "rgb").is_dir())


def _content(path: Path) -> bytes:
    if not path.exists():
        return b""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return b"".join(os.fsencode(file.name) + file.read_bytes() for file in files if file.is_file())


def _solving(folder: Path, rng: Rng) -> list[Arguments]:
    from hybridmap.backends import names

    changed = [path for path in sorted(folder.iterdir()) if _content(path) != _content(valid_of(folder) / path.name)]
    source = str((changed or sorted(folder.iterdir()))[0].relative_to(folder))
    out = ["--out", f"{OUT}/solved.g2o"]
    if rng.random() < 0.1:
        way = ["--incremental"] if rng.random() < 0.5 else []
        return [["compare", source, "--backends", f"odometry,gtsam-lm,{_one_of(names(), rng)}", "--out", f"{OUT}/c", *way]]
    return [["optimize", source, "--backend", _one_of(names(), rng), *out]]


def _configured(folder: Path, rng: Rng) -> list[Arguments]:
    found = [path for path in sorted(folder.glob("*.yaml")) if _content(path) != _content(valid_of(folder) / path.name)]
    name = found[0].name if found else "short.yaml"
    command = ["map", "laser.mcap", "--out", OUT, "--end", "0.7", "--config", name]
    if rng.random() < 0.2:
        key = _one_of(_keys(), rng)
        value = os.fsdecode(_one_of(mutations.TOKENS, rng))
        command = [*command[:-2], "--config", "laser", "--set", f"{key}={value}".replace("\0", "0")]
    return [command]


@cache
def _keys() -> tuple[str, ...]:
    from hybridmap.config import Config

    def dotted(tree: dict[str, Any], at: str = "") -> Iterator[str]:
        for key, value in tree.items():
            yield from dotted(value, f"{at}{key}.") if isinstance(value, dict) else [at + key]

    return tuple(dotted(Config.load("laser").model_dump()))


def _studied(folder: Path, _rng: Rng) -> list[Arguments]:
    """Run the study, with one seed where it rightly asks for more work than a case may take."""
    command = ["study", "study.yaml", "--out", OUT, "--workers", "0"]
    with suppress(Exception):  # whatever it is, the command has to cope with it
        from hybridmap.study.model import StudyConfig

        study = StudyConfig.load(folder / "study.yaml")
        nodes = max((source.synthetic.nodes for source in study.sources if source.synthetic is not None), default=10)
        if nodes > _MOST_NODES or study.statistics.resamples > _MOST_RESAMPLES:
            return []
        if len(study.seeds) > _MOST_SEEDS or any(len(source.seeds or ()) > _MOST_SEEDS for source in study.sources):
            command += ["--set", "seeds=1"]
    return [command]


_MOST_SEEDS, _MOST_NODES, _MOST_RESAMPLES = 5, 300, 5000


def _session_commands(folder: Path, rng: Rng) -> list[Arguments]:
    from hybridmap.export import FORMATS

    name = next((n for n in ("session", "rgbd") if _content(folder / n) != _content(valid_of(folder) / n)), "session")
    form = _one_of(sorted(FORMATS), rng)
    every = [
        ["evaluate", name, "--json"],
        ["evaluate", name, "--loops", "--relations", "relations.txt"],
        ["explain", name, "--node", str(int(rng.integers(6)))],
        ["explain", name, "--frame", "1.0", "--json"],
        ["export", name, "--format", form, "--out", f"{OUT}/e{FORMATS[form].suffix}"],
        ["export", name, "--format", "grid", "--out", f"{OUT}/grid.yaml"],
        ["optimize", name, "--out", f"{OUT}/solved.g2o"],
        ["calibrate", name, "--out", f"{OUT}/c.yaml"],
        ["calibrate", name, "--reference", f"{name}/reference/groundtruth.tum"],
        ["compare", name, "--backends", "odometry,gtsam-lm", "--out", f"{OUT}/c"],
    ]
    weights = np.array([3, 1, 3, 3, 3, 2, 2, 2, 2, 0.4])
    return [every[k] for k in rng.choice(len(every), 2, replace=False, p=weights / weights.sum())]


_TUM_TEXT = ("tum/*.txt", "tum/*.yaml")
KINDS: dict[str, Kind] = {
    **{
        kind: Kind(
            _bags(suffix),
            _either(_files(f"*.{suffix}", ways=BINARY), _in_messages(f"laser.{suffix}", f"laser.{suffix}", f"rgbd.{suffix}")),
            _reading,
        )
        for kind, suffix in (("mcap", "mcap"), ("ros1", "bag"), ("db3", "db3"))
    },
    "tum": Kind(_drive("tum", "rgbd", 1.5), _files(*_TUM_TEXT, ways=TEXT), _reading),
    "pictures": Kind(
        _pictures,
        _either(
            _files("tum/rgb/*", "tum/depth/*", ways=(*BINARY, lying, lying, lying)),
            _in_messages("compressed.mcap", topics="compressed"),
            _in_messages("rgbd.mcap", topics="image"),
        ),
        _reading,
    ),
    "csv": Kind(_csv, _files("*.csv", "*.csv", "*.tum", ways=TEXT), _reading),
    "graph": Kind(_graphs, _files("*.g2o", "*.toro", ways=TEXT), _solving),
    "config": Kind(_configurations, _files("*.yaml", ways=(*TEXT, *(mutations.as_yaml,) * 12)), _configured),
    "study": Kind(_studies, _files("study.yaml", ways=(*TEXT, *(mutations.as_yaml,) * 12)), _studied),
    "session": Kind(
        _sessions,
        _either(
            _files("*/metrics.json", ways=(*TEXT, *(mutations.as_json,) * 12)),
            _files("*/config.yaml", ways=(*TEXT, *(mutations.as_yaml,) * 12)),
            _files("*/trajectory/*", "*/reference/*", "relations.txt", ways=TEXT),
        ),
        _session_commands,
    ),
    "map": Kind(_sessions, _in_map, _session_commands),
}
