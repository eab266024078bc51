"""The simulated stream: a drive through a world, with the data of wheels, camera and laser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SimulationConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import Array
from hybridmap.simulation.motion import DriveLimits, KidnappedDrive, as_transmitted, carry, drive, weaving, wheel_odometry
from hybridmap.simulation.surfaces import World
from hybridmap.simulation.worlds import build_world
from hybridmap.streams.base import Observation, Rig, Sample, SelfMotion, StreamReport
from hybridmap.streams.order import WHOLE, Window
from hybridmap.trajectory import NS_PER_S, Trajectory

if TYPE_CHECKING:
    from hybridmap.simulation.scene import Scene

TURN_RATE_RAD_S = 0.8
"""Fastest turn of the drives: a robot that moves among people."""
ODOMETRY_RATE_HZ = 30.0
"""Odometry messages a second."""
_START_NS = 1_700_000_000 * NS_PER_S
_WHEELS, _CAMERA, _LASER = range(3)
_COUNTED = ("odometry", "frames", "scans")
_CARRIED_SHARE = 0.95  # of the distance that was asked for; a shorter carry is said


class SimulatedStream:
    """A drive through a simulated world, as a stream of odometry, camera frames and laser scans.

    The seed determines the errors of the sensors. Indoors the drive and the world are the same for every seed; the world
    `campus` is another for each. Samples are rounded to the precision of bags and folders, so a recording of the stream reads
    back to the same bits.

    Scans, frames and the ground truth have the stamps of the moment they belong to. With `clock_offset_s` those of odometry are
    that much earlier: scans and frames are late against it.
    """

    def __init__(self, config: SimulationConfig, seed: int, window: Window = WHOLE, world: World | None = None) -> None:
        """Prepare a drive; the world is rendered while iterating.

        Args:
            config: world, drive, sensors.
            seed: of the sensors' errors, and of a world that is drawn by chance.
            window: the part of the drive to give; its samples are those of the whole drive.
            world: the world and its drive; default: those that the configuration names.

        Raises:
            ConfigError: there is no such world, no visited place in it to which the robot could be kidnapped, or nothing in it
                for the camera that is asked for.
            StreamError: the part is not in the drive.
        """
        self._config = config
        self._seed = seed
        self._world: World = world or build_world(config.world, seed)
        if self._world.laser_only and config.sensors != "laser":
            raise ConfigError(
                f"simulation.sensors: found {config.sensors!r}, but {config.world} has nothing for a camera to see; "
                f"expected laser"
            )
        self._report = StreamReport()
        step_s = 1.0 / ODOMETRY_RATE_HZ
        legs = weaving(self._world.legs, config.weave_m) if config.weave_m > 0.0 else self._world.legs
        truth = felt = drive(legs, DriveLimits(self._world.speed_m_s, TURN_RATE_RAD_S), step_s)
        self._carry = None if config.carried_m is None else carry(truth, config.carried_m, step_s)
        if self._carry is not None:
            truth, felt = self._carry.truth, self._carry.felt
        odometry = wheel_odometry(felt, config.wheels, self._generators()[_WHEELS])
        count = len(truth) if config.duration_s is None else max(3, int(config.duration_s * ODOMETRY_RATE_HZ) + 1)
        stamps = _stamps_ns(len(truth), ODOMETRY_RATE_HZ)[:count]
        self._truth = Trajectory(stamps, np.column_stack([truth[:, :2], as_transmitted(truth[:, 2])])[:count])
        late_ns = round(config.clock_offset_s * NS_PER_S)
        self._odometry = Trajectory(stamps - late_ns, odometry[:count])
        if self._carry is not None and self._carry.last >= count:
            raise ConfigError(
                f"simulation.carried_m: the robot is put down again after {self._carry.last * step_s:.1f} s, "
                f"but the drive ends after {config.duration_s:g} s; make simulation.duration_s longer"
            )
        first_ns = min(int(one[0]) for one in (self._odometry.stamps_ns, self._frame_stamps, self._scan_stamps) if len(one))
        self._limits_ns = window.limits_over(self._odometry.stamps_ns, first_ns, self.name)

    @property
    def name(self) -> str:
        """Name of the simulated world."""
        return self._world.name

    @cached_property
    def rig(self) -> Rig:
        """Calibration and mounting of the sensors that the configuration selects."""
        from hybridmap.simulation.sensor_models import camera_of, laser_of

        camera = camera_of(self._config.camera) if self._config.sensors != "laser" else None
        laser = laser_of(self._config.laser) if self._config.sensors != "rgbd" else None
        return Rig(camera=camera, laser=laser)

    @property
    def groundtruth(self) -> Trajectory:
        """True poses of `base_link` in the world, one for each odometry message; on the clock of scans and frames."""
        return self._truth

    @property
    def odometry(self) -> Trajectory:
        """Wheel odometry of the whole drive: poses of `base_link` in `odom`, on the clock of the wheels."""
        return self._odometry

    @property
    def carry(self) -> KidnappedDrive | None:
        """The drive with its kidnapping; None if the robot is not kidnapped."""
        return self._carry

    def _remarks(self) -> list[str]:
        """What the user asked for and the world cannot give."""
        wanted_m = self._config.carried_m
        if self._carry is None or wanted_m is None or self._carry.distance_m >= _CARRIED_SHARE * wanted_m:
            return []
        return [f"carried {self._carry.distance_m:.1f} m, not {wanted_m:g} m: no visited place is farther away"]

    @property
    def expected_observations(self) -> int:
        """Number of camera frames and laser scans that the stream will yield."""
        low, high = self._limits_ns
        stamps = np.concatenate([self._frame_stamps, self._scan_stamps])
        return int(((stamps >= low) & (stamps <= high)).sum())

    @property
    def report(self) -> StreamReport:
        """Number of samples of each kind in the last iteration."""
        return self._report

    def __iter__(self) -> Iterator[Sample]:
        """Yield odometry, frames and scans by stamp; at equal stamps in this order."""
        return self.onward(0, StreamReport(remarks=self._remarks()))

    def first_stamps(self, count: int) -> tuple[int, ...]:
        """Stamps of the first samples, ns; see `SeekableStream`."""
        return tuple(stamp for _, stamp, _ in islice(self._in_order(), count))

    def onward(self, taken: int, report: StreamReport) -> Iterator[Sample]:
        """Iterate without the first `taken` samples, which are not rendered; see `SeekableStream`."""
        self._report = report
        make = self._sensors()
        for kind, stamp, index in islice(self._in_order(), taken, None):
            report.count(_COUNTED[kind])
            if kind == _WHEELS:
                yield SelfMotion(stamp, self._odometry.poses[index].copy())
            else:
                yield make(kind, stamp, index)

    def _in_order(self) -> Iterator[tuple[int, int, int]]:
        """Sensor, stamp and number of each sample of the part."""
        low, high = self._limits_ns
        due = [(int(stamp), _CAMERA, index) for index, stamp in enumerate(self._frame_stamps)]
        due += [(int(stamp), _LASER, index) for index, stamp in enumerate(self._scan_stamps)]
        due += [(int(stamp), _WHEELS, index) for index, stamp in enumerate(self._odometry.stamps_ns)]
        for stamp, kind, index in sorted(due):
            if low <= stamp <= high:
                yield kind, stamp, index

    def _sensors(self) -> Callable[[int, int, int], Observation]:
        """What makes an observation from its sensor, its stamp and its number."""
        from hybridmap.simulation.sensor_models import CameraModel, LaserModel

        generators = self._generators()
        camera = CameraModel(self._scene, self._config.camera, generators[_CAMERA], self._config.noise)
        laser = LaserModel(self._scene, self._config.laser, self._config.noise)
        frame_noise = generators[_CAMERA].spawn(len(self._frame_stamps))
        scan_noise = generators[_LASER].spawn(len(self._scan_stamps))

        def make(kind: int, stamp: int, index: int) -> Observation:
            pose, time_s = self._true_pose(stamp), (stamp - _START_NS) / NS_PER_S
            if kind == _CAMERA:
                return camera.frame(stamp, time_s, pose, frame_noise[index])
            return laser.scan(stamp, time_s, pose, scan_noise[index])

        return make

    def _true_pose(self, stamp_ns: int) -> Array:
        return np.asarray(self._truth.at([stamp_ns])[0])

    @cached_property
    def _scene(self) -> Scene:
        from hybridmap.simulation.scene import Scene

        return Scene(self._world)

    @cached_property
    def _frame_stamps(self) -> NDArray[np.int64]:
        return self._stamps_of(self._config.camera.rate_hz, wanted=self._config.sensors != "laser")

    @cached_property
    def _scan_stamps(self) -> NDArray[np.int64]:
        return self._stamps_of(self._config.laser.rate_hz, wanted=self._config.sensors != "rgbd")

    def _stamps_of(self, rate_hz: float, *, wanted: bool) -> NDArray[np.int64]:
        span_s = float(self._truth.stamps_ns[-1] - _START_NS) / NS_PER_S
        stamps = _stamps_ns(int(span_s * rate_hz) + 2 if wanted else 0, rate_hz)
        stamps = np.asarray(stamps[stamps <= self._truth.stamps_ns[-1]])
        if self._carry is None:
            return stamps
        up, down = self._truth.stamps_ns[self._carry.first], self._truth.stamps_ns[self._carry.last]
        return np.asarray(stamps[(stamps <= up) | (stamps >= down)])

    def _generators(self) -> list[np.random.Generator]:
        return np.random.default_rng(self._seed).spawn(3)


def _stamps_ns(count: int, rate_hz: float) -> NDArray[np.int64]:
    since_start = np.rint(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64)
    return np.asarray(_START_NS + since_start, dtype=np.int64)
