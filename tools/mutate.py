"""Feed spoilt files of every kind to the commands that read them, and count what no bad input may cause.

    python tools/mutate.py --kind mcap --count 1000 --seed 0

A valid file is made by the simulator, spoilt in a reproducible way, and read by the command line in a process with limits.
Counted are tracebacks (any exception that is no error of hybridmap), more than 10 CPU s, more than 1 GB of memory, and files
outside the output folder. Exit code 1 if there was any. `--only NUMBER` repeats one case and shows what it printed.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mutations
import numpy as np
from mutations import BINARY, TEXT, Spoil

CPU_S, MEMORY_BYTES = 10.0, 1 << 30
_HARD_CPU_S, _HARD_MEMORY_BYTES = 15, 3 << 30
_EXIT_CODES = (0, 1, 2, 3)  # done; done with a result that is bad; refused; done with losses under --strict
_BATCH = 100  # cases of one process
_PAGES = 0.05  # share of the mapped recordings that get their page: it takes the most time, and reads no recording
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
        messages = list(_messages(_valid / name))
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
    changed = [path for path in _sources(folder) if _content(path) != _content(_valid / path.name)]
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

    changed = [path for path in sorted(folder.iterdir()) if _content(path) != _content(_valid / path.name)]
    source = str((changed or sorted(folder.iterdir()))[0].relative_to(folder))
    out = ["--out", f"{OUT}/solved.g2o"]
    if rng.random() < 0.1:
        way = ["--incremental"] if rng.random() < 0.5 else []
        return [["compare", source, "--backends", f"odometry,gtsam-lm,{_one_of(names(), rng)}", "--out", f"{OUT}/c", *way]]
    return [["optimize", source, "--backend", _one_of(names(), rng), *out]]


def _configured(folder: Path, rng: Rng) -> list[Arguments]:
    found = [path for path in sorted(folder.glob("*.yaml")) if _content(path) != _content(_valid / path.name)]
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

    name = next((n for n in ("session", "rgbd") if _content(folder / n) != _content(_valid / n)), "session")
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


# ---------------------------------------------------------------------- running a case

_valid = Path()


@dataclass(frozen=True)
class Outcome:
    """What one case did.

    Attributes:
        number: number of the case.
        what: how the file was spoilt.
        command: the last command that was run.
        codes: exit codes of its commands.
        finding: what no input may cause; empty if nothing was wrong.
        detail: where it came from.
    """

    number: int
    what: str
    command: str
    codes: tuple[int, ...]
    finding: str = ""
    detail: str = ""


def run_case(kind: Kind, number: int, seed: int, root: Path, *, show: bool = False) -> Outcome:
    """Spoil one file and read it, in a folder of its own below `root`."""
    rng = np.random.default_rng([seed, number])
    case = root / f"case-{number}" / "in"
    shutil.copytree(_valid, case)
    os.chdir(case)
    what = kind.spoil(case, rng)
    commands = kind.commands(case, rng)
    if not {"map", "study"} & {command[0] for command in commands}:  # these make their output folder themselves
        (case / OUT).mkdir()
    before = _listing(case.parent)
    codes: list[int] = []
    arguments: Arguments = []
    try:
        for arguments in commands:
            code, finding, detail = _measured(arguments, show=show, page=bool(rng.random() < _PAGES))
            codes.append(code)
            strays = sorted(_listing(case.parent) - before)
            if not finding and strays:
                finding, detail = "stray file", ", ".join(strays)
            if finding:
                return Outcome(number, what, " ".join(arguments), tuple(codes), finding, detail)
        return Outcome(number, what, " ".join(arguments), tuple(codes))
    finally:
        os.chdir(root)
        shutil.rmtree(case.parent, ignore_errors=True)


def _listing(folder: Path) -> set[str]:
    """Files and folders outside the output folder, without what `evaluate` and SQLite keep in a session that they read."""
    every = (str(path.relative_to(folder)) for path in folder.rglob("*"))
    return {name for name in every if not name.startswith(f"in/{OUT}") and not name.endswith(("-wal", "-shm", "metrics.json"))}


def _measured(arguments: Arguments, *, show: bool, page: bool) -> tuple[int, str, str]:
    """Exit code of a command, what it did that it must not, and where."""
    started_s, base = time.process_time(), _memory("VmRSS")
    _forget_peak()
    code, detail, finding = 0, "", ""
    with _caught(show) as said, _without_page(page or arguments[0] != "map"):
        try:
            code = hybridmap(*arguments)
        except BaseException as error:  # noqa: BLE001  that is what is looked for
            finding, detail = "traceback", _place(error)
            if show:
                traceback.print_exc(file=sys.__stderr__)
    used_s, grown = time.process_time() - started_s, _memory("VmHWM") - base
    text = said.getvalue().decode("utf-8", "replace")
    if not finding and code not in _EXIT_CODES:
        finding, detail = "exit code", str(code)
    if not finding and code == 2 and text.count("hybridmap: error:") != 1:
        finding, detail = "no message", text[-300:]
    if not finding and used_s > CPU_S:
        finding, detail = "time", f"{used_s:.0f} CPU s"
    if not finding and (grown > MEMORY_BYTES or "not enough memory" in text):
        finding, detail = "memory", f"{grown / 1e9:.1f} GB; {text[-200:]}"
    if not finding and "Warning:" in text:
        finding, detail = "(warning)", next(line for line in text.splitlines() if "Warning:" in line)
    return code, finding, detail


def _place(error: BaseException) -> str:
    """The error and the last line of ours that it came through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/hybridmap/" in frame.filename]
    at = (ours or frames)[-1]
    return f"{Path(at.filename).name}:{at.lineno} {at.name}: {type(error).__name__}: {' '.join(str(error).split())[:120]}"


class _Kept(io.BytesIO):
    """What was printed; it stays when the stream around it is closed."""

    def close(self) -> None:
        pass


@contextmanager
def _caught(show: bool) -> Iterator[io.BytesIO]:
    """Take what is printed; a name that is not UTF-8 is refused by standard output, as on a terminal."""
    said, printed, out, err = _Kept(), _Kept(), sys.stdout, sys.stderr
    sys.stdout = io.TextIOWrapper(printed, "utf-8", errors="strict", write_through=True)
    sys.stderr = io.TextIOWrapper(said, "utf-8", errors="backslashreplace", write_through=True)
    try:
        yield said
    finally:
        if show:
            print(printed.getvalue().decode("utf-8", "replace")[-3000:], said.getvalue().decode(), file=out)
        sys.stdout, sys.stderr = out, err


@contextmanager
def _without_page(page: bool) -> Iterator[None]:
    import hybridmap.report as report

    whole = report.write_report
    if not page:
        report.write_report = lambda *_args, **_named: Path()
    try:
        yield
    finally:
        report.write_report = whole


def _memory(name: str) -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split(f"{name}:")[1].split()[0])


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


# ---------------------------------------------------------------------- many cases


def run_all(kind: Kind, numbers: range, seed: int, root: Path) -> Iterator[Outcome]:
    """Run the cases in forked processes; one that dies counts for the case it was at."""
    todo = list(numbers)
    while todo:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _work(kind, todo[:_BATCH], seed, root, writing)
        os.close(writing)
        done = 0
        with os.fdopen(reading) as lines:
            for line in lines:
                fields = json.loads(line)
                yield Outcome(**{**fields, "codes": tuple(fields["codes"])})
                done += 1
        _, status = os.waitpid(child, 0)
        if done < len(todo[:_BATCH]):
            died = f"the process ended with {os.waitstatus_to_exitcode(status)}"
            yield Outcome(todo[done], "", "", (), "died", died)
            done += 1
        todo = todo[done:]


def _work(kind: Kind, numbers: list[int], seed: int, root: Path, writing: int) -> None:
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    with os.fdopen(writing, "w", buffering=1) as out:
        for number in numbers:
            used_s = int(time.process_time())
            resource.setrlimit(resource.RLIMIT_CPU, (used_s + _HARD_CPU_S, resource.RLIM_INFINITY))
            limit = _memory("VmSize") + _HARD_MEMORY_BYTES
            resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
            outcome = run_case(kind, number, seed, root)
            out.write(json.dumps(outcome.__dict__, default=str) + "\n")
    os._exit(0)


def main() -> int:
    """Run the cases of one kind, or of all; print what was found."""
    parser = argparse.ArgumentParser(description="Feed spoilt files to the commands that read them.")
    parser.add_argument("--kind", choices=[*KINDS, "all"], default="all")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--valid", type=Path, help="folder that keeps the valid files for the next run")
    parser.add_argument("--only", type=int, help="repeat this case and show what it prints")
    arguments = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ[name] = "1"
    chosen = list(KINDS) if arguments.kind == "all" else [arguments.kind]
    rows = []
    for name in chosen:
        with tempfile.TemporaryDirectory(prefix="mutate-") as place:
            root = Path(place)
            _prepare(KINDS[name], root / "valid" if arguments.valid is None else arguments.valid.resolve() / name)
            if arguments.only is not None:
                print(run_case(KINDS[name], arguments.only, arguments.seed, root, show=True))
                continue
            started_s = time.monotonic()
            numbers = range(arguments.first, arguments.first + arguments.count)
            rows.append((name, _told(run_all(KINDS[name], numbers, arguments.seed, root)), time.monotonic() - started_s))
    columns = ("traceback", "time", "memory", "stray file", "exit code", "no message", "died", "(warning)")
    print("  ".join(["kind".ljust(9), "cases", "read", "refused", *columns, "s"]))
    for name, (counts, codes), took_s in rows:
        cells = [str(counts[column]).rjust(len(column)) for column in columns]
        read, total = codes[0] + codes[1] + codes[3], sum(counts.values())
        print(
            "  ".join([name.ljust(9), str(total).rjust(5), str(read).rjust(4), str(codes[2]).rjust(7), *cells, f"{took_s:.0f}"])
        )
    return int(any(counts[column] for _, (counts, _), _ in rows for column in columns if column[0] != "("))


def _told(outcomes: Iterator[Outcome]) -> tuple[Counter[str], Counter[int]]:
    """Count the findings and the last exit codes, and print each finding."""
    counts: Counter[str] = Counter()
    codes: Counter[int] = Counter()
    for outcome in outcomes:
        counts[outcome.finding] += 1
        codes[outcome.codes[-1] if outcome.codes else -1] += 1
        if outcome.finding:
            text = f"{outcome.number}: {outcome.finding}: {outcome.detail} | {outcome.what} | {outcome.command}"
            print(text.encode("utf-8", "backslashreplace").decode(), flush=True)
    return counts, codes


def _prepare(kind: Kind, valid: Path) -> None:
    """Write the valid files in a process of its own, and load what the cases need, so that none pays for it."""
    global _valid
    _valid = valid
    if not valid.exists():
        valid.mkdir(parents=True)
        child = os.fork()
        if child == 0:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            kind.seed(valid)
            os._exit(0)
        os.waitpid(child, 0)
    import cv2
    import gtsam
    import matplotlib.pyplot
    import open3d
    import rosbags.rosbag1
    import rosbags.rosbag2
    import scipy.optimize

    import hybridmap.cli.app
    import hybridmap.session  # noqa: F401

    del cv2, gtsam, matplotlib, open3d, rosbags, scipy


if __name__ == "__main__":
    raise SystemExit(main())
