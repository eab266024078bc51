"""The interface of sensor streams: samples in time order, sensors, kinds of sensors, and a report of losses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.geometry import Array
from hybridmap.trajectory import NS_PER_S, Trajectory, format_stamp

if TYPE_CHECKING:
    from hybridmap.streams.bagindex import BagIndex, TopicChooser

Keyframe = Mapping[str, NDArray[Any]]
"""What a map keeps of a node's observation: arrays by name."""
MessageKey = tuple[str, int]
"""A message of a bag: topic, and its place within the topic."""
_SKIPS_NAMED = 3
"""How many damaged observations are named; one kind of damage looks the same again and again."""


@dataclass(frozen=True, slots=True)
class SelfMotion:
    """One odometry message: pose of `base_link` in `odom`.

    Attributes:
        stamp_ns: header stamp, ns.
        pose_odom_robot: (3,) float64, m and rad.
    """

    precedence: ClassVar[int] = 0
    stamp_ns: int
    pose_odom_robot: Array


@dataclass(frozen=True, slots=True)
class Velocity:
    """One velocity command or wheel-speed reading; it is valid until the next one (zero-order hold).

    Attributes:
        stamp_ns: stamp, ns.
        v_m_s: forward speed, m/s.
        omega_rad_s: turn rate, counter-clockwise positive, rad/s.
    """

    precedence: ClassVar[int] = 0
    stamp_ns: int
    v_m_s: float
    omega_rad_s: float


@dataclass(frozen=True, slots=True)
class Observation:
    """A measurement of an exteroceptive sensor at one time; each kind of sensor has its own subclass.

    Attributes:
        precedence: order of samples with equal stamps, lowest first; self-motion has 0.
        stamp_ns: header stamp, ns.
    """

    precedence: ClassVar[int] = 1
    stamp_ns: int


Motion = SelfMotion | Velocity
Sample = Motion | Observation


@dataclass(frozen=True, init=False)
class Rig:
    """The exteroceptive sensors of a stream with their mountings: `Rig(laser=laser, camera=camera)`.

    Attributes:
        sensors: name of a sensor (`SensorKind.sensor_name`) -> the sensor.
    """

    sensors: Mapping[str, Any]

    def __init__(self, **sensors: Any) -> None:
        object.__setattr__(self, "sensors", {name: sensor for name, sensor in sensors.items() if sensor is not None})


@dataclass(frozen=True, slots=True)
class Seen:
    """The points that a sensor saw from one keyframe, in `base_link`.

    Attributes:
        xyz: (P, 3) points, m.
        rgb: (P, 3) their colours in 0..1; None without colour.
        origin: (2,) position of the sensor, m.
        bearings: (P,) bearings of the points, increasing along the sweep, rad, for a sensor that scans a level plane; None for
            points of any height.
        column_rad: width of the vertical columns in which the nearest point hides those behind it, rad.
    """

    xyz: Array
    rgb: Array | None
    origin: Array
    bearings: Array | None = None
    column_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Planned:
    """An observation that will be read from a bag.

    Attributes:
        stamp_ns: its stamp, ns.
        needs: keys of the messages that it is made of.
    """

    stamp_ns: int
    needs: tuple[MessageKey, ...]


class Decoder(Protocol):
    """Makes an observation from its messages, and counts irregularities in `counts`: name -> number.

    Every count becomes a remark `<name>: <number>`, so the name says what was irregular and what was done.
    """

    counts: dict[str, int]

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> Observation:
        """Make the observation of this stamp from its decoded messages, in the order of `Planned.needs`."""


@dataclass(slots=True)
class SensorPlan:
    """All observations of one kind of sensor in a bag, before they are read.

    Attributes:
        rig: the sensor, with its mounting.
        planned: the observations, in order of stamp.
        decode: (stamp, decoded messages) -> observation; None if there is nothing to decode.
        losses: name -> number of messages that no observation uses.
        remarks: assumptions that were made, for the user.
    """

    rig: Rig = field(default_factory=Rig)
    planned: list[Planned] = field(default_factory=list)
    decode: Decoder | None = None
    losses: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


class Gatherer(Protocol):
    """Tells while messages come in which of them make an observation: the same ones as the plan of a whole recording."""

    def push(self, topic: str, number: int, stamp_ns: int) -> list[Planned]:
        """Take in a message by its header stamp, ns; returns the observations that are sure now, in order of stamp."""

    def flush(self) -> list[Planned]:
        """The end: returns what the messages that wait give."""

    @property
    def waiting(self) -> frozenset[MessageKey]:
        """The messages that may still make an observation."""

    @property
    def losses(self) -> Mapping[str, int]:
        """Name -> number of messages so far that no observation uses."""


class EachMessage:
    """Gathers an observation from every message, for a sensor with one topic."""

    waiting: frozenset[MessageKey] = frozenset()
    losses: Mapping[str, int] = MappingProxyType({})

    def __init__(self, topics: Mapping[str, str], config: SensorsConfig) -> None:
        del topics, config  # every message is one of the topic

    def push(self, topic: str, number: int, stamp_ns: int) -> list[Planned]:
        """The observation of this message."""
        return [Planned(stamp_ns, ((topic, number),))]

    def flush(self) -> list[Planned]:
        """Nothing waits."""
        return []


@dataclass(frozen=True, slots=True)
class InBag:
    """How a kind of sensor is found in a bag, and how its messages become observations.

    Attributes:
        types: message types, each with a header.
        find: chooses topics: role (such as `color`) -> topic, empty if the bag has none.
        plan: (topics by role, index of the bag, base frame, settings, path of the bag) -> all observations. Raises a
            StreamError if something is missing, also for no topics at all, as the user may have asked for this kind.
        gather: (topics by role, settings) -> what finds the same observations as `plan` while messages come in from a robot.
    """

    types: tuple[str, ...]
    find: Callable[[TopicChooser], dict[str, str]]
    plan: Callable[[Mapping[str, str], BagIndex, str, SensorsConfig, str], SensorPlan]
    gather: Callable[[Mapping[str, str], SensorsConfig], Gatherer] = EachMessage


@dataclass(frozen=True, slots=True)
class SensorKind:
    """Definition of a kind of exteroceptive sensor; `streams.sensors` has the table of kinds.

    Attributes:
        name: value of `vision.sensor` that selects it.
        sensor_name: name of its sensor in the rig and the map file.
        sensor: type of the sensor, a dataclass of numbers and arrays.
        sample: type of its observations.
        counted: name of observations in counts (`scans`).
        needs: what a source must have, in words (`laser scans`).
        words: sensor -> short description, for people.
        front_end: makes the front-end for loop closure, a `vision.Factory`; or its `module:name`, imported when needed.
        compact: observation -> the part of it that the map file stores.
        restore: (keyframe with what `compact` returned, stamp of its node) -> the observation; None if it has no such data.
        see: (keyframe, sensor, range in m) -> its points up to that range; None if it has no data of this kind.
        seeks_every: name of the setting with the travel between two searches for loops, m; empty string: at every node.
        in_bag: how it is found in a bag; None: never.
        configured: configuration -> the sensor, for users who feed the mapper themselves; None if it is not configured.
    """

    name: str
    sensor_name: str
    sensor: type[Any]
    sample: type[Observation]
    counted: str
    needs: str
    words: Callable[[Any], str]
    front_end: str | Callable[..., Any]
    compact: Callable[[Any], dict[str, NDArray[Any]]]
    restore: Callable[[Keyframe, int], Observation | None]
    see: Callable[[Keyframe, Any, float], Seen | None]
    seeks_every: str = ""
    in_bag: InBag | None = None
    configured: Callable[[SensorsConfig], Any | None] = lambda _: None


@dataclass(slots=True)
class StreamReport:
    """What reading a stream found.

    Attributes:
        counts: name (`odometry`, `frames`, `unmatched color`, ...) -> number.
        remarks: choices and assumptions, for the user.
        lost: topic or list of pictures -> (messages that were not used, messages in all), where the recording states to hold
            messages that cannot be read, or damaged ones were skipped.
        skipped: what was skipped as damaged, in words with stamp and place, in the order of reading.
        dropped: kind of observation (`scans`) -> number of those that a live mapper left out, as it was too slow for them.
        irregular: name of an irregularity -> number so far, as decoding counts them; they are added to `counts` at the end.
    """

    counts: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    lost: dict[str, tuple[int, int]] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    irregular: dict[str, int] = field(default_factory=dict)

    def skip(self, name: str, total: int, stamp_ns: int, why: str) -> None:
        """Count a damaged observation as a lost message of a topic or list that has `total` messages in all.

        Args:
            name, total: the topic or list of pictures, and how many messages it has.
            stamp_ns: stamp of the observation, ns.
            why: what is damaged, and where, in words.
        """
        gone, stated = self.lost.get(name, (0, total))
        self.lost[name] = (gone + 1, stated)
        self.skipped.append(f"{format_stamp(stamp_ns)} s: {why}")

    @property
    def skips(self) -> list[str]:
        """What was skipped as damaged, for people: the first few, then how many more."""
        more = len(self.skipped) - _SKIPS_NAMED
        named = [f"skipped, stamp {one}" for one in self.skipped[:_SKIPS_NAMED]]
        return [*named, f"skipped {more} more that {'is' if more == 1 else 'are'} damaged"] if more > 0 else named

    def count(self, name: str, increment: int = 1) -> None:
        """Add `increment` to the count of this name."""
        self.counts[name] = self.counts.get(name, 0) + increment


class Stream(Protocol):
    """A source of samples, in order of stamp; of samples with equal stamps, motion comes first.

    A stream can be iterated several times and gives the same samples each time.
    """

    @property
    def name(self) -> str:
        """Name of the file or folder without its path, or of the simulated world; for reports, not to open it again."""

    @property
    def rig(self) -> Rig:
        """The sensors with their mountings; known before the first sample is read."""

    @property
    def groundtruth(self) -> Trajectory | None:
        """True poses of `base_link`; None if unknown."""

    @property
    def expected_observations(self) -> int | None:
        """Number of observations that the stream will give, for a progress bar; None if unknown."""

    @property
    def report(self) -> StreamReport:
        """What the last iteration over the stream found, as far as it went."""

    def __iter__(self) -> Iterator[Sample]:
        """Yield the samples.

        Raises:
            StreamError: the source is damaged; the message says where.
        """


@runtime_checkable
class SeekableStream(Stream, Protocol):
    """A stream that can leave out its first samples without the work of making them."""

    def first_stamps(self, count: int) -> tuple[int, ...]:
        """Stamps of the first samples, ns, of `count` or all, also of those that turn out to be damaged; nothing is read."""

    def onward(self, taken: int, report: StreamReport) -> Iterator[Sample]:
        """Iterate as always, but without the first `taken` samples.

        `report` is what the iteration that gave these had found right after the last of them; it is continued.

        Raises:
            StreamError: the source is damaged; the message says where.
        """


def stamp_s(sample: Sample) -> float:
    """Stamp of a sample in seconds."""
    return sample.stamp_ns / NS_PER_S
