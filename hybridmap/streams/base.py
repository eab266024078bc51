"""What a sensor stream is: samples in time order, the sensors, what a kind of sensor is, and what was lost on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.geometry import Array
from hybridmap.trajectory import NS_PER_S, Trajectory

if TYPE_CHECKING:
    from hybridmap.streams.bagindex import BagIndex, TopicChooser

Keyframe = Mapping[str, NDArray[Any]]
"""What a map keeps of a node's observation: arrays by name."""
MessageKey = tuple[str, int]
"""A message of a bag: topic, and its place within the topic."""


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
    """One velocity command or wheel-speed reading; it holds until the next one (zero-order hold)."""

    precedence: ClassVar[int] = 0
    stamp_ns: int
    v_m_s: float
    omega_rad_s: float


@dataclass(frozen=True, slots=True)
class Observation:
    """What an exteroceptive sensor saw at one instant; each kind of sensor has its own subclass.

    Attributes:
        precedence: at equal stamps the sample with the lower one comes first; self-motion has 0.
        stamp_ns: header stamp, ns.
    """

    precedence: ClassVar[int] = 1
    stamp_ns: int


Motion = SelfMotion | Velocity
Sample = Motion | Observation


@dataclass(frozen=True, init=False)
class Rig:
    """The exteroceptive sensors of a stream and where they sit: `Rig(laser=laser, camera=camera)`.

    Attributes:
        sensors: by the name that their kind gives them; only those that are there.
    """

    sensors: Mapping[str, Any]

    def __init__(self, **sensors: Any) -> None:
        object.__setattr__(self, "sensors", {name: sensor for name, sensor in sensors.items() if sensor is not None})


@dataclass(frozen=True, slots=True)
class Seen:
    """What a keyframe shows, in `base_link`.

    Attributes:
        xyz: (P, 3) points, m.
        rgb: (P, 3) their colours in 0..1, None without colour.
        origin: (2,) where the sensor sits, m.
        bearings: (P,) rad, increasing along the sweep, of a sensor that scans a level plane; None: points of any height.
        column_rad: width of the columns in which the nearest of such points hides those behind it, rad.
    """

    xyz: Array
    rgb: Array | None
    origin: Array
    bearings: Array | None = None
    column_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Planned:
    """An observation that is to come: its stamp, and the messages that it is made of."""

    stamp_ns: int
    needs: tuple[MessageKey, ...]


class Decoder(Protocol):
    """Makes an observation of the messages that it needs; counts what was odd about them."""

    counts: dict[str, int]

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> Observation:
        """Decode the messages of one observation."""


@dataclass(slots=True)
class SensorPlan:
    """All observations of a bag.

    Attributes:
        rig: the sensor, with its mounting.
        planned: in order of stamp.
        decode: makes an observation of a stamp and the decoded messages.
        losses: counts of what found no partner.
        remarks: what was assumed.
    """

    rig: Rig = field(default_factory=Rig)
    planned: list[Planned] = field(default_factory=list)
    decode: Decoder | None = None
    losses: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class InBag:
    """How a kind of sensor is found in a bag, and what is made of its messages.

    Attributes:
        types: message types, each with a header.
        find: chooses the topics: role -> topic, empty where the bag has none.
        plan: (topics, index, base frame, settings, file) -> every observation. It raises a StreamError where something is
            missing, also for empty topics, as the user may have asked for this kind.
    """

    types: tuple[str, ...]
    find: Callable[[TopicChooser], dict[str, str]]
    plan: Callable[[Mapping[str, str], BagIndex, str, SensorsConfig, str], SensorPlan]


@dataclass(frozen=True, slots=True)
class SensorKind:
    """All that tells one kind of exteroceptive sensor from another; `streams.sensors` has the table of them.

    Attributes:
        name: what `vision.sensor` calls it.
        sensor_name: what the rig and the map file call its sensor.
        sensor: type of the sensor, a dataclass of numbers and arrays.
        sample: type of its observations.
        counted: what observations are called in counts (`scans`).
        needs: what a source must have for it (`laser scans`).
        words: says in a few words what a sensor is.
        front_end: makes what closes loops with it, a `vision.Factory`; or its `module:name`, imported when it is needed.
        compact: what the map file keeps of an observation.
        restore: the observation that `compact` was given; None where a keyframe has none. The stamp is the node's.
        see: points of a keyframe up to a range, m; None where it holds nothing of this kind.
        seeks_every: setting of the travel after which its front-end looks for loops, m; empty: it looks at every node.
        in_bag: how it is found in a bag; None: it never is.
        configured: the sensor that a configuration alone describes, for those who feed the mapper themselves.
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
    """What a stream met while it was read: counts by name (`odometry`, `frames`, `unmatched color`, ...) and remarks."""

    counts: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)

    def count(self, name: str, increment: int = 1) -> None:
        """Add to a named count."""
        self.counts[name] = self.counts.get(name, 0) + increment


class Stream(Protocol):
    """A source of samples, in order of stamp; at equal stamps motion comes before observations.

    A stream can be iterated more than once and gives the same samples each time.
    """

    @property
    def name(self) -> str:
        """What to call it in a report: file name or world."""

    @property
    def rig(self) -> Rig:
        """The sensors; known before the first sample."""

    @property
    def groundtruth(self) -> Trajectory | None:
        """True poses of `base_link`, where they are known."""

    @property
    def expected_observations(self) -> int | None:
        """How many observations will come, for a progress bar; None where unknown."""

    @property
    def report(self) -> StreamReport:
        """What the last iteration met."""

    def __iter__(self) -> Iterator[Sample]:
        """Yield the samples.

        Raises:
            StreamError: the source is damaged; the message says where.
        """


def stamp_s(sample: Sample) -> float:
    """Stamp in seconds."""
    return sample.stamp_ns / NS_PER_S
