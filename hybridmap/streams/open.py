"""Open any source by its name: simulated world, bag, folder or velocity table."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from hybridmap.config.root import Config
from hybridmap.errors import StreamError
from hybridmap.plugins import loaded
from hybridmap.streams.base import Stream
from hybridmap.streams.order import Window

_SIMULATOR = "hybridmap.simulation"
"""A house of its own above this one, known by name alone."""

EXPECTED = (
    "a simulated world, a ROS 1 bag (.bag), a ROS 2 bag (folder with metadata.yaml, .mcap, .db3), "
    "a TUM RGB-D folder or a velocity table (.csv)"
)


_OPENERS = {
    "ROS 1 bag": "rosbag:BagStream",
    "ROS 2 bag": "rosbag:BagStream",
    "TUM RGB-D folder": "tum:TumStream",
    "velocity table": "velocity:VelocityStream",
}
"""Kind of a source -> what opens it, imported when it is needed."""
_KIND_OF_SUFFIX = {".bag": "ROS 1 bag", ".mcap": "ROS 2 bag", ".db3": "ROS 2 bag", ".csv": "velocity table"}
_SIGNS_OF_TUM = ("rgb.txt", "depth.txt", "associations.txt", "rgb", "depth")


def world_of(source: str | Path) -> str | None:
    """Name of the simulated world that a source names (`office` or `sim:office`); None if it names none.

    In a string the name of a world takes precedence over a file of that name; write `./office` for the file. A `Path` is a
    file, unless it begins with `sim:`.

    Raises:
        StreamError: `sim:` with an unknown world.
    """
    text = str(source)
    explicit = text.startswith("sim:")
    name = text.removeprefix("sim:")
    if not explicit and (isinstance(source, Path) or "/" in name or "." in name):
        return None
    known = tuple(_simulator().world_names())
    if name in known:
        return name
    if explicit:
        raise StreamError(f"{text}: no such simulated world; worlds: {', '.join(known)}")
    return None


def kind_of(path: Path, expected: str = "") -> str:
    """The kind of a source by its name and content: ROS 1 bag, ROS 2 bag, TUM RGB-D folder or velocity table.

    Args:
        path: the source.
        expected: what is taken, for messages; empty: all that can be mapped.

    Raises:
        StreamError: the path does not exist, is empty, or is of no readable kind.
    """
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return "ROS 2 bag"
        if any((path / sign).exists() for sign in _SIGNS_OF_TUM):
            return "TUM RGB-D folder"
        bags = sorted(p.name for p in path.iterdir() if p.suffix in _KIND_OF_SUFFIX)
        hint = f"; it holds {', '.join(bags[:5])}: give one of these" if bags else ""
        raise StreamError(f"{path}: a folder that is neither a ROS 2 bag nor a TUM RGB-D folder{hint}")
    if not path.exists():
        found = "no such file or folder" if expected else "no such file, folder or simulated world"
        raise StreamError(f"{path}: {found}; expected {expected or EXPECTED}")
    if path.stat().st_size == 0:
        raise StreamError(f"{path}: the file is empty")
    kind = _KIND_OF_SUFFIX.get(path.suffix.lower())
    if kind is None:
        raise StreamError(f"{path}: unknown kind of file {path.suffix!r}; expected {expected or EXPECTED}")
    return kind


def open_stream(
    source: str | Path,
    config: Config,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    skip_damaged: bool = False,
) -> Stream:
    """Open a recording, or a simulated world by name.

    Args:
        source: path, or name of a world: `office` or `sim:office`.
        config: topics, mounting and synchronisation; for a world, the simulated drive.
        start_s, end_s: use only this part, seconds from the first stamp, both inclusive; None: no limit.
        skip_damaged: leave out damaged scans and pictures of a recording, and count them in the stream's report (`lost`).

    Raises:
        StreamError: the source cannot be opened, or cannot be mapped; the message says why.
    """
    window = Window(start_s, end_s)
    world = world_of(source)
    if world is not None:
        simulation = config.simulation.model_copy(update={"world": world})
        simulated: Stream = _simulator().SimulatedStream(simulation, config.seed, window)
        return simulated
    path = Path(source)
    opened: Stream = loaded(f"hybridmap.streams.{_OPENERS[kind_of(path)]}")(path, config, window, skip_damaged=skip_damaged)
    return opened


def _simulator() -> Any:
    return import_module(_SIMULATOR)
