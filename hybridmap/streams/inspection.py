"""Inspect a source: its contents, what mapping would use, and what is missing or damaged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.root import Config
from hybridmap.errors import HybridMapError, StreamError, counted
from hybridmap.streams.base import Rig, Stream, StreamReport
from hybridmap.streams.open import kind_of, open_stream, world_of
from hybridmap.trajectory import NS_PER_S, read_tum

_LONG_GAP_S = 1.0


@dataclass(frozen=True, slots=True)
class Part:
    """One topic, list or file of a source.

    Attributes:
        name: name of the topic or file.
        kind: message type, or kind of file.
        count: number of messages, images or rows.
        stamps_ns: header stamps in recorded order, ns; empty if unknown.
    """

    name: str
    kind: str
    count: int
    stamps_ns: NDArray[np.int64]

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Earliest and latest stamp, s; None if unknown."""
        if not len(self.stamps_ns):
            return None
        return float(self.stamps_ns.min() / NS_PER_S), float(self.stamps_ns.max() / NS_PER_S)

    @property
    def duration_s(self) -> float:
        """Latest minus earliest stamp, s; 0 if unknown."""
        return int(self.stamps_ns.max() - self.stamps_ns.min()) / NS_PER_S if len(self.stamps_ns) else 0.0

    @property
    def rate_hz(self) -> float:
        """Mean rate of the messages, Hz; NaN if unknown."""
        return (len(self.stamps_ns) - 1) / self.duration_s if self.duration_s > 0 else float("nan")

    @property
    def longest_gap_s(self) -> float:
        """Longest time without a message, s; 0 if unknown."""
        return float(np.diff(np.sort(self.stamps_ns)).max(initial=0) / NS_PER_S)


@dataclass(slots=True)
class Inspection:
    """What an inspection of a source found.

    Attributes:
        source: path or name of the source.
        kind: kind of source: `ROS 1 bag`, `TUM RGB-D folder`, ...
        parts: topics or files of the source.
        uses: role (such as `odometry`, `color`) -> topic or file that mapping would use.
        rig: sensors that mapping would use.
        remarks: choices and assumptions, for the user.
        problems: missing or damaged parts, one line each.
        lost: topic -> (messages that cannot be read, messages in all), for the topics that mapping would use.
        reason: why the source cannot be mapped; None if it can.
        only_skipping: whether a scan or picture was found to be damaged, so that mapping has to skip damaged ones.
    """

    source: str
    kind: str
    parts: list[Part] = field(default_factory=list)
    uses: dict[str, str] = field(default_factory=dict)
    rig: Rig = field(default_factory=Rig)
    remarks: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    lost: dict[str, tuple[int, int]] = field(default_factory=dict)
    reason: str | None = None
    only_skipping: bool = False

    @property
    def mappable(self) -> bool:
        """Whether the source can be mapped."""
        return self.reason is None


def inspect_source(source: str | Path, config: Config, *, skip_damaged: bool = False) -> Inspection:
    """Inspect a source without mapping it.

    Args:
        source: a path, or the name of a simulated world.
        config: topic names, mounting, sensor.
        skip_damaged: read every scan and picture of a recording, and count the damaged ones among the lost messages.

    Raises:
        StreamError: the source cannot be opened at all.
    """
    world = world_of(source)
    if world is not None:
        found = Inspection(str(source), "simulated world", remarks=["rendered while it is mapped; nothing is missing"])
        _try_to_open(found, source, config)
        return found
    path = Path(source)
    found = Inspection(str(path), kind_of(path))
    found.parts = _PARTS[found.kind](path, found.problems)
    _try_to_open(found, source, config, skip_damaged=skip_damaged)
    found.problems += [line for part in found.parts if part.name in found.uses.values() for line in _gaps(part)]
    if found.kind == "velocity table":
        found.remarks.append("a velocity table: dead reckoning and the neural part only")
    return found


def _try_to_open(found: Inspection, source: str | Path, config: Config, *, skip_damaged: bool = False) -> None:
    """Open as mapping would; note what it would use, or why it cannot."""
    try:
        stream = open_stream(source, config, skip_damaged=skip_damaged)
        truth = stream.groundtruth
        report = _read_whole(stream) if skip_damaged else StreamReport(lost=getattr(stream, "lost", {}))
    except HybridMapError as error:
        found.reason = str(error)
        found.problems.append(str(error))
        return
    found.rig = stream.rig
    found.uses |= getattr(stream, "uses", {})
    found.remarks += getattr(stream, "remarks", [])
    found.lost |= report.lost
    losses: dict[str, int] = getattr(stream, "losses", {})
    found.problems += [f"{count} {name}" for name, count in losses.items() if count]
    found.problems += [
        f"{name}: {gone} of {counted(stated, 'message')} cannot be read" for name, (gone, stated) in found.lost.items()
    ]
    found.problems += report.skips
    if truth is not None:
        found.remarks.append(f"ground truth: {counted(len(truth), 'pose')}")


def _read_whole(stream: Stream) -> StreamReport:
    """Read a whole stream; returns what that found."""
    for _ in stream:
        pass
    return stream.report


def _gaps(part: Part) -> list[str]:
    """A line about the longest time without a message, if that is unusually long."""
    if len(part.stamps_ns) < 2:
        return []
    stamps = np.sort(part.stamps_ns)
    steps = np.diff(stamps) / NS_PER_S
    longest = int(np.argmax(steps))
    if steps[longest] < max(_LONG_GAP_S, 5.0 * float(np.median(steps))):
        return []
    after_s = int(stamps[longest] - stamps[0]) / NS_PER_S
    return [f"{part.name}: nothing for {steps[longest]:.2f} s, {after_s:.1f} s after its beginning"]


def _bag_parts(path: Path, problems: list[str]) -> list[Part]:
    from hybridmap.streams.bagfile import BagFile
    from hybridmap.streams.bagindex import ODOMETRY
    from hybridmap.streams.sensors import message_types

    bag = BagFile(path)
    types = ODOMETRY + message_types()
    stamped = [topic.name for topic in bag.topics if topic.msgtype in types and topic.count]
    stamps: dict[str, list[int]] = {name: [] for name in stamped}
    try:
        for message in bag.raw(stamped):
            stamps[message.topic].append(bag.stamp_ns(message))
    except StreamError as error:
        problems.append(str(error))
    parts = []
    for topic in bag.topics:
        seen = np.asarray(stamps.get(topic.name, []), dtype=np.int64)
        parts.append(Part(topic.name, topic.msgtype.replace("/msg/", "/"), topic.count, seen))
        if topic.name in stamps and len(seen) != topic.count:
            problems.append(
                f"{topic.name}: {counted(len(seen), 'message')} can be read of the {topic.count} that the bag says it holds"
            )
        if topic.count == 0:
            problems.append(f"{topic.name}: no messages")
    return parts


def _tum_parts(path: Path, problems: list[str]) -> list[Part]:
    from hybridmap.streams.tum import read_picture_list

    parts = []
    for name in ("associations.txt", "rgb.txt", "depth.txt"):
        if (path / name).is_file():
            parts += _part_or_problem(path / name, "pictures", lambda p: read_picture_list(p)[0], problems)
    for file in sorted(path.glob("*.txt")):
        if file.name.startswith(("odom", "groundtruth")):
            kind = "odometry" if file.name.startswith("odom") else "ground truth"
            parts += _part_or_problem(file, kind, lambda p: read_tum(p).stamps_ns, problems)
    if not (path / "camera.yaml").is_file():
        problems.append("camera.yaml: no calibration and mounting")
    return parts


def _part_or_problem(path: Path, kind: str, read: Callable[[Path], NDArray[np.int64]], problems: list[str]) -> list[Part]:
    try:
        stamps = read(path)
    except StreamError as error:
        problems.append(str(error))
        return [Part(path.name, kind, 0, np.zeros(0, dtype=np.int64))]
    return [Part(path.name, kind, len(stamps), stamps)]


def _velocity_parts(path: Path, problems: list[str]) -> list[Part]:
    from hybridmap.streams.velocity import read_table

    return _part_or_problem(path, "velocities", lambda p: np.array([row.stamp_ns for row in read_table(p)]), problems)


_PARTS: dict[str, Callable[[Path, list[str]], list[Part]]] = {
    "ROS 1 bag": _bag_parts,
    "ROS 2 bag": _bag_parts,
    "TUM RGB-D folder": _tum_parts,
    "velocity table": _velocity_parts,
}
