"""Synchronise self-motion and observations: makes the steps that a mapper takes, one after the other.

The mapper calls it, so a live robot and a recording give the same steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hybridmap.errors import StreamError
from hybridmap.geometry import IDENTITY, Array, between, compose, exp, interpolate
from hybridmap.streams.base import Motion, Observation, Sample, SelfMotion, StreamReport, Velocity
from hybridmap.streams.order import ReorderBuffer
from hybridmap.trajectory import NS_PER_S, format_stamp

_MAX_HOLD_NS = NS_PER_S  # observations further behind the last odometry are dropped at the end


@dataclass(frozen=True, slots=True)
class Ready:
    """One step of the mapper.

    Attributes:
        stamp_ns: stamp at the end of the step, ns.
        delta_robot: (3,) pose of the robot in its own frame at the previous step, m and rad; zeros for the first step.
        dt_s: time since the previous step, s; 0 for the first.
        pose_odom_robot: (3,) pose in `odom` at the stamp (velocities: integrated from the identity), m and rad.
        observation: the observation at the stamp; None for a step of self-motion alone.
        odometry_ns: stamp of the self-motion before any `retime`, ns; None for a step with an observation.
    """

    stamp_ns: int
    delta_robot: Array
    dt_s: float
    pose_odom_robot: Array
    observation: Observation | None = None
    odometry_ns: int | None = None


class Synchroniser:
    """Sorts samples by stamp and turns them into steps; at equal stamps motion comes before observations.

    Every distinct stamp of self-motion gives one step without observation. Every observation gives one step, at the odometry
    interpolated to its stamp, once odometry at or after that stamp has arrived. Of odometry messages with equal stamps the
    first counts; of velocities the last, since each is valid until the next.

    The samples of a recording come in order, and `latency_s` is 0. A live robot's messages arrive out of order across topics:
    each sample waits `latency_s`, so that earlier ones can still come. An observation older than the last step, or than the
    first odometry, is dropped and counted in `report`, without an error. Self-motion that comes later than that is an error,
    and so is an observation older than one that waits for its odometry.
    """

    def __init__(self, latency_s: float = 0.0, odometry_delay_s: float = 0.0) -> None:
        """Start without any sample.

        Args:
            latency_s: samples are held until the newest stamp is this much later, s; 0 for sorted streams.
            odometry_delay_s: added to the stamps of self-motion, to put them on the clock of the observations, s.
        """
        self.report = StreamReport()
        self._arrived = ReorderBuffer(latency_s + abs(odometry_delay_s))
        self._odometry_delay_ns = round(odometry_delay_s * NS_PER_S)
        self._aligned = ReorderBuffer(0.0)
        self._later_ns = 0  # by `retime`
        self._last: tuple[int, Array] | None = None  # newest self-motion: stamp, pose
        self._velocity: Velocity | None = None
        self._kind: type | None = None
        self._step: tuple[int, Array] | None = None  # newest step given out: stamp, pose
        self._waiting: deque[Observation] = deque()

    def retime(self, later_s: float) -> None:
        """From the next sample on, add `later_s`, which may be negative, to the stamps of self-motion, beside the first delay.

        Steps stay in order of stamp. Self-motion that now lies before the last step is left out; its motion is in the step
        that follows. Call it once, and between two steps.
        """
        self._later_ns = round(later_s * NS_PER_S)
        self._aligned = ReorderBuffer(abs(later_s))
        if self._last is not None:
            self._last = self._last[0] + self._later_ns, self._last[1]

    def push(self, sample: Sample) -> Iterator[Ready]:
        """Add a sample, and yield the steps that have become ready. It is taken in only when the steps are iterated over.

        Raises:
            StreamError: self-motion goes back in time, or an observation goes back behind one that waits for odometry (both
                after `latency_s`); self-motion is not finite; or odometry is mixed with velocities. An observation behind the
                last step, or before the first odometry, is dropped and counted in `report`, without an error.
        """
        if self._odometry_delay_ns and isinstance(sample, SelfMotion | Velocity):
            sample = replace(sample, stamp_ns=sample.stamp_ns + self._odometry_delay_ns)
        for arrived in self._arrived.push(sample):
            yield from self._align(arrived)

    def flush(self) -> Iterator[Ready]:
        """End of the stream: yield the steps of all samples that still wait.

        Observations up to 1 s after the last odometry get its pose; later ones are dropped and counted.
        """
        for arrived in self._arrived.flush():
            yield from self._align(arrived)
        for sample in self._aligned.flush():
            yield from self._take(sample)
        if self._last is None:
            self._drop("observations before odometry", len(self._waiting))
            self._waiting.clear()
            return
        stamp_ns, pose = self._last
        held = [sample for sample in self._waiting if sample.stamp_ns - stamp_ns <= _MAX_HOLD_NS]
        self._drop("observations after odometry", len(self._waiting) - len(held))
        self._waiting.clear()
        for sample in held:
            yield self._make(sample.stamp_ns, pose, sample)

    def _align(self, sample: Sample) -> Iterator[Ready]:
        """Put a sample on the clock of the observations; samples come in order of their stamps before that."""
        if isinstance(sample, SelfMotion | Velocity):
            sample = replace(sample, stamp_ns=sample.stamp_ns + self._later_ns)
        for aligned in self._aligned.push(sample):
            yield from self._take(aligned)

    def _take(self, sample: Sample) -> list[Ready]:
        return self._push_observation(sample) if isinstance(sample, Observation) else self._push_motion(sample)

    def _push_motion(self, sample: Motion) -> list[Ready]:
        self._check_motion(sample)
        if self._last is None:
            pose = sample.pose_odom_robot if isinstance(sample, SelfMotion) else IDENTITY
            before = [waiting for waiting in self._waiting if waiting.stamp_ns < sample.stamp_ns]
            self._drop("observations before odometry", len(before))
            self._waiting = deque(waiting for waiting in self._waiting if waiting.stamp_ns >= sample.stamp_ns)
            steps = [self._make_motion(sample, pose)]
        elif sample.stamp_ns == self._last[0]:
            self.report.count("equal odometry stamps")
            self._velocity = sample if isinstance(sample, Velocity) else None
            return []
        else:
            pose = sample.pose_odom_robot if isinstance(sample, SelfMotion) else self._held(sample.stamp_ns)
            steps = self._release(sample.stamp_ns, pose)
            if self._step is None or sample.stamp_ns > self._step[0]:  # else left out, see `retime`
                steps.append(self._make_motion(sample, pose))
        self._last = (sample.stamp_ns, pose)
        self._velocity = sample if isinstance(sample, Velocity) else None
        while self._waiting and self._waiting[0].stamp_ns == sample.stamp_ns:
            steps.append(self._make(sample.stamp_ns, pose, self._waiting.popleft()))
        return steps

    def _push_observation(self, sample: Observation) -> list[Ready]:
        if self._waiting and sample.stamp_ns < self._waiting[-1].stamp_ns:
            raise StreamError(
                f"observation at stamp {format_stamp(sample.stamp_ns)} s goes back behind "
                f"{format_stamp(self._waiting[-1].stamp_ns)} s; expected observations in order of stamp"
            )
        if self._last is None or sample.stamp_ns > self._last[0]:
            self._waiting.append(sample)
            return []
        if self._step is not None and sample.stamp_ns < self._step[0]:
            self._drop("observations behind odometry", 1)
            return []
        return [self._make(sample.stamp_ns, self._last[1], sample)]

    def _release(self, stamp_ns: int, pose: Array) -> list[Ready]:
        """Steps of the observations between the previous and the new self-motion sample."""
        assert self._last is not None
        steps = []
        before_ns, before = self._last
        while self._waiting and self._waiting[0].stamp_ns < stamp_ns:
            sample = self._waiting.popleft()
            at_ns = max(sample.stamp_ns, before_ns)  # it may lie before that just after `retime`
            if self._velocity is not None:
                there = self._held(at_ns)
            else:
                there = interpolate(before, pose, (at_ns - before_ns) / (stamp_ns - before_ns))
            steps.append(self._make(sample.stamp_ns, there, sample))
        return steps

    def _held(self, stamp_ns: int) -> Array:
        """Pose at a stamp with the last velocity held: an exact arc."""
        assert self._last is not None
        assert self._velocity is not None
        dt_s = (stamp_ns - self._last[0]) / NS_PER_S
        twist = np.array([self._velocity.v_m_s * dt_s, 0.0, self._velocity.omega_rad_s * dt_s])
        return compose(self._last[1], exp(twist))

    def _make_motion(self, sample: Motion, pose: Array) -> Ready:
        return replace(self._make(sample.stamp_ns, pose, None), odometry_ns=sample.stamp_ns - self._later_ns)

    def _make(self, stamp_ns: int, pose: Array, observation: Observation | None) -> Ready:
        if self._step is None:
            delta, dt_s = IDENTITY, 0.0
        else:
            delta, dt_s = between(self._step[1], pose), (stamp_ns - self._step[0]) / NS_PER_S
        self._step = (stamp_ns, pose)
        return Ready(stamp_ns, delta, dt_s, pose, observation)

    def _check_motion(self, sample: Motion) -> None:
        stamp = format_stamp(sample.stamp_ns)
        if self._kind not in (None, type(sample)):
            raise StreamError(f"stamp {stamp} s: odometry and velocities are mixed; expected one kind of self-motion")
        self._kind = type(sample)
        values = sample.pose_odom_robot if isinstance(sample, SelfMotion) else (sample.v_m_s, sample.omega_rad_s)
        if not np.isfinite(values).all():
            raise StreamError(f"odometry at stamp {stamp} s: found NaN or Inf, expected finite numbers")
        if self._last is not None and sample.stamp_ns < self._last[0]:
            raise StreamError(
                f"odometry at stamp {stamp} s goes back behind {format_stamp(self._last[0])} s; expected stamps in order"
            )

    def _drop(self, name: str, number: int) -> None:
        if number:
            self.report.count(name, number)
