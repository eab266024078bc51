"""The live mapper: what a robot's own program calls while it drives."""

from __future__ import annotations

import threading
import time
from collections import Counter
from concurrent.futures import Future
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.config import Config
from hybridmap.errors import HybridMapError, LiveError
from hybridmap.export.keyframes import OccupancyGrid
from hybridmap.geometry import Array, compose, inverse
from hybridmap.live import doctor
from hybridmap.live.drawing import Artist
from hybridmap.live.drive import LiveDrive, LiveReport
from hybridmap.live.inbox import LiveLimits
from hybridmap.live.locating import Locator
from hybridmap.live.messages import Ask, Begin, Done, Dropped, End, Ready, Reset, Save, Saved, Snapshot
from hybridmap.live.odometry import SmoothedCorrection
from hybridmap.live.process import MappingProcess
from hybridmap.live.samples import check, check_kind, require_elsewhere, stamp_ns_of, used
from hybridmap.session import Session
from hybridmap.streams.base import Observation, Rig, Sample, SelfMotion, Velocity
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame

_LOOK_S = 0.1
"""Views that wait grow old also while nothing comes, and are looked at so often, s."""


class LiveMapper:
    """Maps while a robot drives. Every call returns at once, whatever the mapper is at, unless its description says otherwise.

    ```python
    with LiveMapper(Config.load("laser"), rig, Path("session")) as mapper:
        mapper.add_odometry(stamp_s, pose_odom_robot)
        mapper.add_scan(stamp_s, ranges_m)
        pose = mapper.pose_map_robot()
    ```

    The map is made in a process of its own, by the code that maps a recording, and written into a session folder as the robot
    drives. Samples may come in any order across sources: the map is the same as that of a recording of them, bit for bit,
    unless samples are left out; `report` counts those. If this process dies, the other one concludes the session.

    Leaving the `with` block finishes the session. Methods may be called from any thread.
    """

    def __init__(
        self,
        config: Config,
        rig: Rig,
        out: Path,
        *,
        name: str = "live",
        limits: LiveLimits | None = None,
        overwrite: bool = False,
        process: MappingProcess | None = None,
    ) -> None:
        """Start the mapping process and wait until it is set up, some seconds.

        Args:
            config: every setting; saved resolved.
            rig: the sensors, as `streams.sensors.rig_of` makes them from a configuration.
            out: the session folder.
            name: name of the source in the session, for people.
            limits: of lag and correction.
            overwrite: replace a session that exists.
            process: one that was started before, so that less has to be waited for.

        Raises:
            ConfigError, BackendError, StreamError: the configuration names something that does not exist, or that is registered
                in this program alone.
            OutputError: the folder cannot be used, or another run is writing there.
            LiveError: the mapping process cannot be started.
        """
        require_elsewhere(config, rig)
        self._limits, self._rig = limits or LiveLimits(), used(rig, config.vision.sensor)
        self._changed = threading.Condition()
        self._outgoing: list[Any] = []  # messages that go before any sample
        self._told: Counter[tuple[str, str]] = Counter()  # what the child knows of samples that were left out
        self._saved: dict[int, Future[None]] = {}
        self._numbers = 0
        self._ready: Future[None] = Future()
        self._resets = threading.Lock()  # one after the other
        self._result: Future[Session] = Future()
        self._ended_s: float | None = None  # when `finish` was called
        self._drive = LiveDrive(self._rig, self._limits)
        self._out = out
        self._artist = Artist(out)
        self._locator: Locator | None = None
        self._process = process or MappingProcess()
        self._process.begin(Begin(config, self._rig, out, name, overwrite), self._receive, self._fail)
        try:
            self._ready.result()
        except BaseException:
            self._process.close()
            raise
        threading.Thread(target=self._feed, name="hybridmap-feed", daemon=True).start()

    # ------------------------------------------------------------------ samples

    def add_odometry(self, stamp_s: float, pose_odom_robot: ArrayLike) -> None:
        """Take in a pose (3,) of `base_link` in `odom`, m and rad. Errors are those of `add`."""
        self.add(SelfMotion(stamp_ns_of(stamp_s), np.array(pose_odom_robot, dtype=np.float64)))

    def add_velocity(self, stamp_s: float, v_m_s: float, omega_rad_s: float) -> None:
        """Take in a forward speed and a turn rate that hold until the next call. Errors are those of `add`."""
        self.add(Velocity(stamp_ns_of(stamp_s), float(v_m_s), float(omega_rad_s)))

    def add_rgbd(self, stamp_s: float, color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> None:
        """Take in a frame: color (H, W, 3) uint8 RGB, depth (H, W) float32 in m, 0 where invalid. Errors are those of `add`.

        The arrays must not be changed afterwards.
        """
        self.add(RgbdFrame(stamp_ns_of(stamp_s), color, depth_m))

    def add_scan(self, stamp_s: float, ranges_m: ArrayLike) -> None:
        """Take in a scan (B,), m, NaN or Inf where there is no return. Errors are those of `add`."""
        ranges = np.array(ranges_m, dtype=np.float32)
        ranges[~np.isfinite(ranges)] = np.nan
        self.add(LaserScan(stamp_ns_of(stamp_s), ranges))

    def add(self, sample: Sample) -> None:
        """Take in any sample, in any order across the sources; those of one source should come in order of stamp.

        Raises:
            StreamError: the sample is not finite or has another shape than its sensor, the rig has no such sensor, or
                odometry is mixed with velocities. The sample is left out, and mapping goes on.
            LiveError, or the mapper's own error: the mapping process has ended.
        """
        check(sample, self._rig)
        now_s = time.monotonic()
        with self._changed:
            self._require_running()
            check_kind(sample, self._drive.odometry.kind)
            if not isinstance(sample, Observation):
                self._drive.odometry.add(sample)
            self._drive.inbox.add(sample, now_s)
            self._changed.notify()

    # ------------------------------------------------------------------ poses

    @property
    def pose_map_odom(self) -> Array:
        """(3,) the newest correction `map -> odom` (REP-105), m and rad; a loop closure makes it jump."""
        return self._drive.pose_map_odom

    def smoothed_map_odom(self, now_s: float) -> SmoothedCorrection:
        """The correction, slowed to `LiveLimits.correction_m_s` and `correction_deg_s`, at a time of any steady clock, s."""
        with self._changed:
            drive = self._drive
            return drive.smoother.step(now_s, drive.pose_map_odom, drive.odometry.newest)

    def pose_map_robot(self, stamp_s: float | None = None) -> Array:
        """(3,) the robot on the map: its newest odometry, or that at a stamp, by the newest correction; m and rad.

        Raises:
            StreamError: the stamp lies before the odometry that is kept, some 4000 messages.
        """
        drive = self._drive
        pose = drive.odometry.newest if stamp_s is None else drive.odometry.at(stamp_ns_of(stamp_s))
        return compose(drive.pose_map_odom, pose)

    @property
    def pose_base_map(self) -> Array | None:
        """(3,) pose of this drive's map in the frame of the map that `localise` was given, m and rad.

        The robot is there at `compose(pose_base_map, pose_map_robot())`. None while its place is not known.

        Raises:
            HybridMapError: the search has ended by an error.
        """
        locator = self._locator
        if locator is not None and locator.error is not None:
            raise locator.error
        return None if locator is None else locator.pose_base_map

    @property
    def snapshot(self) -> Snapshot:
        """The newest map that the mapping process has sent, after about every node."""
        return self._drive.snapshot

    # ------------------------------------------------------------------ how it is doing

    @property
    def report(self) -> LiveReport:
        """Numbers of samples, what was left out, and the lag."""
        with self._changed:
            return self._drive.report(self._state, time.monotonic())

    @property
    def pid(self) -> int:
        """Number of the mapping process."""
        return self._process.pid

    def doctor(self) -> list[str]:
        """What is wrong with the input, in sentences: sources that are missing, late, or on another clock; empty if nothing."""
        with self._changed:
            return doctor.sentences(self._drive.inbox, self._ended_s or time.monotonic())

    # ------------------------------------------------------------------ services

    def pause(self) -> None:
        """Leave views out until `resume`. Odometry is taken in all the same, as the robot may be moved meanwhile."""
        self._drive.inbox.paused = True

    def resume(self) -> None:
        """Take in views again."""
        self._drive.inbox.paused = False

    def save(self, timeout_s: float | None = None) -> None:
        """Write everything so far into the session folder, and wait until it is there; others may read it meanwhile.

        Raises:
            LiveError: no answer in this time, or the mapping process has ended.
        """
        saved: Future[None] = Future()
        with self._changed:
            self._require_running()
            number = self._numbers = self._numbers + 1
            self._saved[number] = saved
            self._outgoing.append(Save(number))
            self._changed.notify()
        _waited(saved, timeout_s)

    def grid(self, resolution_m: float = 0.05, timeout_s: float | None = None) -> OccupancyGrid:
        """Draw the occupancy grid of the newest snapshot and wait for it. A third process does it, so mapping goes on.

        Raises:
            ExportError: the map shows no obstacle yet.
            LiveError: it is not there in this time, or its process has ended.
        """
        return self._artist.grid(self._drive.snapshot.poses, resolution_m, timeout_s)

    def localise(self, base: Path | None) -> None:
        """Look for the robot on a finished map, in a further process, from now on; None: no longer.

        The drive is mapped all the same, and the finished map is not changed.

        Args:
            base: its session folder.

        Raises:
            StoreError: the map is missing, damaged or not finished, or of other sensors.
        """
        locator = None if base is None else Locator(base, self._out, lambda: self._drive.snapshot.poses)
        before, self._locator = self._locator, locator
        if before is not None:
            before.close()
        if locator is not None:
            locator.look()

    def guess(self, pose_base_robot: ArrayLike) -> None:
        """Say where the robot may be on the map that `localise` was given, (3,) m and rad: it is looked for there first.

        It is believed only if views agree; a wrong one costs a search. Without `localise` it does nothing.
        """
        if self._locator is not None:
            self._locator.guess(compose(np.asarray(pose_base_robot, dtype=np.float64), inverse(self.pose_map_robot())))

    def reset(self) -> None:
        """Leave the map and begin a new one in its place; waits until the step that is being done has ended."""
        with self._resets:
            with self._changed:
                self._require_running()
                self._ready = Future()
                self._drive = LiveDrive(self._rig, self._limits)
                self._told.clear()
                self._outgoing.append(Reset())
                self._changed.notify()
            self._ready.result()
        if self._locator is not None:
            self.localise(self._locator.base)

    def finish(self, timeout_s: float | None = None) -> Session:
        """End of the drive: map what still waits, conclude the session as at the end of a recording, and wait for it.

        Raises:
            StreamError: nothing was mapped.
            LiveError: no answer in this time, or the mapping process has ended.
        """
        with self._changed:
            self._ended_s = self._ended_s or time.monotonic()
            self._changed.notify()
        session: Session = _waited(self._result, timeout_s)
        return session

    def close(self) -> None:
        """Let go of the mapping process without waiting; what was not finished it concludes by itself."""
        self._fail(LiveError("the live mapper was closed"))
        self._process.close()
        self._artist.close()
        self.localise(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None and not self._result.done():
                self.finish()
        finally:
            self.close()

    # ------------------------------------------------------------------ the mapping process

    @property
    def _state(self) -> str:
        if self._result.done():
            return "failed" if self._result.exception() is not None else "finished"
        if self._ended_s is not None:
            return "finishing"
        return "paused" if self._drive.inbox.paused else "mapping"

    def _require_running(self) -> None:
        if self._result.done():
            self._result.result()
        if self._ended_s is not None:
            raise LiveError("the session is finished; make a new LiveMapper")

    def _feed(self) -> None:
        """Send what has to be sent, in a thread of its own, until the end."""
        while not self._result.done():
            with self._changed:
                messages = self._next()
                if not messages:
                    self._changed.wait(_LOOK_S)
            self._process.send(messages)
            if messages and isinstance(messages[-1], End):
                return

    def _next(self) -> list[Any]:
        """The messages to send now."""
        now_s, orders, ending = time.monotonic(), self._outgoing, self._ended_s is not None
        self._outgoing = []
        inbox = self._drive.inbox
        samples = inbox.flush(now_s) if ending else inbox.take(now_s)
        asked = [Ask()] if inbox.is_held_up else []
        left_out = inbox.left_out
        news = [Dropped(*key, number) for key, number in (left_out - self._told).items()]
        self._told = left_out
        return [*orders, *news, *samples, *([End()] if ending else asked)]

    def _receive(self, message: Any) -> None:
        """Take in a message of the mapping process."""
        with self._changed:
            if isinstance(message, Ready):
                self._ready.set_result(None)
            elif isinstance(message, Saved):
                self._saved.pop(message.number).set_result(None)
            elif not self._ready.done():
                return  # of the map that was left
            elif isinstance(message, Done):
                times_s = message.busy_s, message.motion_s, time.monotonic()
                self._drive.inbox.done(message.consumed, message.mapped, *times_s)
                self._drive.correction = message.pose_map_odom
            elif isinstance(message, Snapshot):
                self._drive.snapshot, self._drive.correction = message, message.pose_map_odom
                if self._locator is not None:
                    self._locator.look()
            elif isinstance(message, Session) and not self._result.done():
                self._result.set_result(message)
            self._changed.notify()

    def _fail(self, error: HybridMapError) -> None:
        """End everything that waits for the mapping process, by an error."""
        with self._changed:
            waiting: list[Future[Any]] = [self._ready, self._result, *self._saved.values()]
            for future in waiting:
                if not future.done():
                    future.set_exception(error)
            self._changed.notify()


def _waited(future: Future[Any], timeout_s: float | None) -> Any:
    try:
        return future.result(timeout_s)
    except TimeoutError:
        raise LiveError(f"the mapping process gave no answer in {timeout_s} s") from None
