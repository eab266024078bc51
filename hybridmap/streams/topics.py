"""Which topics of a bag are used: found by type and common names, or named in the configuration."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.streams.bagfile import Topic
from hybridmap.streams.base import Rig, SensorKind

ODOMETRY = ("nav_msgs/msg/Odometry",)
TRANSFORM = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_TRUTH = re.compile(r"ground_?truth|(^|[/_])(gt|truth|mocap|vicon)([/_]|$)", re.IGNORECASE)
TRANSPORT = re.compile(r"/(compressed|compressedDepth)$")
"""What image_transport adds to the name of a topic."""

_ODOMETRY_NAMES = (r"^/odom$", r"^/(odometry|wheel_odom|wheel_odometry)$", r"wheel", r"/odom$", r"odom")
"""The first pattern that fits counts; what fits none comes last."""


@dataclass(slots=True)
class Selection:
    """The topics that are used; None where there is none.

    Attributes:
        odometry: nav_msgs/Odometry topic.
        odometry_tf: whether self-motion comes from the transforms instead.
        groundtruth: nav_msgs/Odometry topic with the true pose.
        sensors: name of a sensor -> its topics by role.
        transforms: every topic with transforms.
        remarks: choices that the user may want to know of.
    """

    odometry: str | None = None
    odometry_tf: bool = False
    groundtruth: str | None = None
    sensors: dict[str, dict[str, str]] = field(default_factory=dict)
    transforms: tuple[str, ...] = ()
    remarks: list[str] = field(default_factory=list)

    def uses(self, rig: Rig) -> dict[str, str]:
        """Role -> topic, of those that are used with the sensors of a rig."""
        motion = ", ".join(self.transforms) if self.odometry_tf else self.odometry
        found = {} if motion is None else {"odometry": motion}
        for name in rig.sensors:
            found |= self.sensors.get(name, {})
        return found | ({} if self.groundtruth is None else {"groundtruth": self.groundtruth})


def is_static(topic: str) -> bool:
    """Whether a transform topic is the static one."""
    return topic.endswith("tf_static")


def looks_like_truth(topic: str) -> bool:
    """Whether a topic's name says that it holds the true pose."""
    return _TRUTH.search(topic) is not None


def select(
    topics: Sequence[Topic],
    config: SensorsConfig,
    kinds: Iterable[SensorKind],
    frame_of: Callable[[str], str],
    source: str,
) -> Selection:
    """Choose the topics of a bag.

    Args:
        topics: what the bag holds.
        config: names that the user gave.
        kinds: of the sensors to look for.
        frame_of: first header's frame of a topic.
        source: file, for errors.

    Raises:
        StreamError: a named topic does not exist or is of the wrong type; the message lists the candidates.
    """
    chooser = TopicChooser([topic for topic in topics if topic.count], config, source)
    chosen = Selection(transforms=tuple(topic.name for topic in chooser.of(TRANSFORM)), remarks=chooser.remarks)
    _select_odometry(chooser, chosen, frame_of)
    for kind in kinds:
        if kind.in_bag is not None and kind.sensor_name not in chosen.sensors:
            chosen.sensors[kind.sensor_name] = kind.in_bag.find(chooser)
    return chosen


class TopicChooser:
    """Picks topics of a bag by type and name.

    Attributes:
        remarks: choices that the user may want to know of.
    """

    def __init__(self, topics: Sequence[Topic], config: SensorsConfig, source: str) -> None:
        self._topics, self._config, self._source = topics, config, source
        self.remarks: list[str] = []

    def of(self, types: Iterable[str]) -> list[Topic]:
        """All topics of some message types."""
        return [topic for topic in self._topics if topic.msgtype in types]

    def named(self, setting: str, types: tuple[str, ...]) -> str | None:
        """The topic that a setting of `sensors` names, if it names one.

        Raises:
            StreamError: there is no such topic of these types.
        """
        wanted = getattr(self._config, setting)
        if wanted is None:
            return None
        candidates = [topic.name for topic in self.of(types)]
        for name in (wanted, "/" + wanted):
            if name in candidates:
                return str(name)
        kinds = " or ".join(kind.replace("/msg/", "/") for kind in types)
        listed = ", ".join(candidates) or "none"
        raise StreamError(
            f"{self._source}: sensors.{setting}: no topic {wanted!r} of type {kinds} with messages; found: {listed}"
        )

    def best(self, types: tuple[str, ...], names: Sequence[str], keep: Callable[[str], bool] = lambda _: True) -> str | None:
        """The topic with the most usual name, then the most messages."""
        candidates = [topic for topic in self.of(types) if keep(topic.name)]
        if not candidates:
            return None

        def preference(topic: Topic) -> tuple[int, int, int, str]:
            plain = TRANSPORT.sub("", topic.name)
            rank = next((i for i, pattern in enumerate(names) if re.search(pattern, plain, re.IGNORECASE)), len(names))
            return rank, -topic.count, types.index(topic.msgtype), topic.name

        ranked = sorted(candidates, key=preference)
        if len(ranked) > 1:
            others = ", ".join(topic.name for topic in ranked[1:])
            self.remarks.append(f"took {ranked[0].name} ({ranked[0].count} messages) rather than {others}")
        return ranked[0].name


def _select_odometry(chooser: TopicChooser, chosen: Selection, frame_of: Callable[[str], str]) -> None:
    wanted = chooser.named("odometry_topic", ODOMETRY + TRANSFORM)
    if wanted in chosen.transforms:
        chosen.odometry_tf, wanted = True, None
    chosen.odometry = wanted
    truths = [
        topic
        for topic in chooser.of(ODOMETRY)
        if topic.name != wanted and (looks_like_truth(topic.name) or frame_of(topic.name) == "world")
    ]
    chosen.groundtruth = chooser.named("groundtruth_topic", ODOMETRY) or (truths[0].name if truths else None)
    hidden = {topic.name for topic in truths} | {chosen.groundtruth}
    if wanted is None and not chosen.odometry_tf:
        chosen.odometry = chooser.best(ODOMETRY, _ODOMETRY_NAMES, keep=lambda name: name not in hidden)
        chosen.odometry_tf = chosen.odometry is None and any(not is_static(name) for name in chosen.transforms)
