"""Which topics of a bag are used: found by type and common names, or named in the configuration."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.streams.bagfile import Topic

ODOMETRY = ("nav_msgs/msg/Odometry",)
SCAN = ("sensor_msgs/msg/LaserScan",)
IMAGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = ("sensor_msgs/msg/CameraInfo",)
TRANSFORM = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_TRUTH = re.compile(r"ground_?truth|(^|[/_])(gt|truth|mocap|vicon)([/_]|$)", re.IGNORECASE)
_NO_COLOR = re.compile(r"depth|infra|(^|[/_])ir([/_]|$)|mask|label|disparity|confidence|segment", re.IGNORECASE)
_DEPTH = re.compile(r"depth", re.IGNORECASE)
_TRANSPORT = re.compile(r"/(compressed|compressedDepth)$")

# The first pattern that fits counts; what fits none comes last.
_ODOMETRY_NAMES = (r"^/odom$", r"^/(odometry|wheel_odom|wheel_odometry)$", r"wheel", r"/odom$", r"odom")
_SCAN_NAMES = (r"^/scan$", r"^/base_scan$", r"/(scan|base_scan)$", r"front|laser")
_COLOR_NAMES = (r"rect_color|color/image_rect", r"(color|rgb)/image", r"color|rgb", r"image")
_DEPTH_NAMES = (r"aligned_depth|depth_registered|depth_to_color|depth_to_rgb", r"depth/image", r"image")


@dataclass(slots=True)
class Selection:
    """The topics that are used; None where there is none.

    Attributes:
        odometry: nav_msgs/Odometry topic.
        odometry_tf: whether self-motion comes from the transforms instead.
        scan, color, depth, color_info, depth_info, groundtruth: as they say.
        transforms: every topic with transforms.
        remarks: choices that the user may want to know of.
    """

    odometry: str | None = None
    odometry_tf: bool = False
    scan: str | None = None
    color: str | None = None
    depth: str | None = None
    color_info: str | None = None
    depth_info: str | None = None
    groundtruth: str | None = None
    transforms: tuple[str, ...] = ()
    remarks: list[str] = field(default_factory=list)

    def uses(self) -> dict[str, str]:
        """Role -> topic, of those that are used."""
        roles = ("odometry", "scan", "color", "depth", "color_info", "depth_info", "groundtruth")
        found = {role: str(getattr(self, role)) for role in roles if getattr(self, role) is not None}
        if self.odometry_tf:
            found["odometry"] = ", ".join(self.transforms)
        return found


def is_static(topic: str) -> bool:
    """Whether a transform topic is the static one."""
    return topic.endswith("tf_static")


def looks_like_truth(topic: str) -> bool:
    """Whether a topic's name says that it holds the true pose."""
    return _TRUTH.search(topic) is not None


def select(topics: Sequence[Topic], config: SensorsConfig, frame_of: Callable[[str], str], source: str) -> Selection:
    """Choose the topics of a bag.

    Args:
        topics: what the bag holds.
        config: names that the user gave.
        frame_of: first header's frame of a topic.
        source: file, for errors.

    Raises:
        StreamError: a named topic does not exist or is of the wrong type; the message lists the candidates.
    """
    chooser = _Chooser([topic for topic in topics if topic.count], config, source)
    chosen = Selection(transforms=tuple(topic.name for topic in chooser.of(TRANSFORM)))
    _select_odometry(chooser, chosen, config, frame_of)
    chosen.scan = chooser.named("scan_topic", SCAN) or chooser.best(SCAN, _SCAN_NAMES, chosen.remarks)
    _select_images(chooser, chosen)
    return chosen


class _Chooser:
    def __init__(self, topics: Sequence[Topic], config: SensorsConfig, source: str) -> None:
        self._topics, self._config, self._source = topics, config, source

    def of(self, types: Iterable[str]) -> list[Topic]:
        return [topic for topic in self._topics if topic.msgtype in types]

    def named(self, setting: str, types: tuple[str, ...]) -> str | None:
        """The topic that the configuration names, if it names one."""
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

    def best(
        self, types: tuple[str, ...], names: Sequence[str], remarks: list[str], keep: Callable[[str], bool] = lambda _: True
    ) -> str | None:
        """The topic with the most usual name, then the most messages."""
        candidates = [topic for topic in self.of(types) if keep(topic.name)]
        if not candidates:
            return None

        def preference(topic: Topic) -> tuple[int, int, int, str]:
            plain = _TRANSPORT.sub("", topic.name)
            rank = next((i for i, pattern in enumerate(names) if re.search(pattern, plain, re.IGNORECASE)), len(names))
            return rank, -topic.count, types.index(topic.msgtype), topic.name

        ranked = sorted(candidates, key=preference)
        if len(ranked) > 1:
            others = ", ".join(topic.name for topic in ranked[1:])
            remarks.append(f"took {ranked[0].name} ({ranked[0].count} messages) rather than {others}")
        return ranked[0].name


def _select_odometry(chooser: _Chooser, chosen: Selection, config: SensorsConfig, frame_of: Callable[[str], str]) -> None:
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
        chosen.odometry = chooser.best(ODOMETRY, _ODOMETRY_NAMES, chosen.remarks, keep=lambda name: name not in hidden)
        chosen.odometry_tf = chosen.odometry is None and any(not is_static(name) for name in chosen.transforms)


def _select_images(chooser: _Chooser, chosen: Selection) -> None:
    remarks = chosen.remarks
    chosen.depth = chooser.named("depth_topic", IMAGE) or chooser.best(
        IMAGE, _DEPTH_NAMES, remarks, keep=lambda name: _DEPTH.search(name) is not None
    )
    colors = [t.name for t in chooser.of(IMAGE) if _NO_COLOR.search(t.name) is None and t.name != chosen.depth]
    beside = [name for name in colors if chosen.depth is not None and _namespace(name) == _namespace(chosen.depth)]
    chosen.color = chooser.named("color_topic", IMAGE) or chooser.best(
        IMAGE, _COLOR_NAMES, remarks, keep=lambda name: name in (beside or colors)
    )
    infos = [topic.name for topic in chooser.of(CAMERA_INFO)]
    chosen.color_info = chooser.named("camera_info_topic", CAMERA_INFO) or _info_of(chosen.color, infos, alone_is_enough=True)
    chosen.depth_info = chooser.named("depth_info_topic", CAMERA_INFO) or _info_of(chosen.depth, infos, alone_is_enough=False)


def _namespace(topic: str) -> str:
    """First part of a topic's name: the camera, as a rule."""
    return topic.strip("/").split("/")[0]


def _info_of(image: str | None, infos: Sequence[str], *, alone_is_enough: bool) -> str | None:
    """The CameraInfo topic beside an image topic, as image_transport has it."""
    if image is None:
        return None
    plain = _TRANSPORT.sub("", image)
    parent = plain.rsplit("/", 1)[0]
    for name in (f"{parent}/camera_info", f"{plain}/camera_info"):
        if name in infos:
            return name
    others = [name for name in infos if alone_is_enough and not _DEPTH.search(name)]
    return others[0] if len(others) == 1 else infos[0] if alone_is_enough and len(infos) == 1 else None
