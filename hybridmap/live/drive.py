"""The state of one live drive, as the robot's process knows it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array, inverse
from hybridmap.live.inbox import Inbox, LiveLimits
from hybridmap.live.messages import empty_snapshot
from hybridmap.live.odometry import ReceivedOdometry, Smoother
from hybridmap.streams.base import Rig
from hybridmap.streams.sensors import carried


@dataclass(frozen=True, slots=True)
class LiveReport:
    """How a live mapper is doing.

    Attributes:
        state: `mapping`, `paused`, `finishing`, `finished` or `failed`.
        samples: source -> number of samples that came.
        dropped: source -> reason -> number of them that the mapper did not get.
        lag_s, largest_lag_s: how long the oldest view that the mapper could have mapped by now has been waiting for it, and the
            largest so far.
        waiting_s: how long the oldest view has been waiting for odometry, or for another source that may have an older one.
        nodes: nodes of the newest snapshot.
    """

    state: str
    samples: Mapping[str, int]
    dropped: Mapping[str, Mapping[str, int]]
    lag_s: float
    largest_lag_s: float
    waiting_s: float
    nodes: int


class LiveDrive:
    """What belongs to one map, so that a new one replaces all of it at once.

    Attributes:
        inbox: the samples that wait.
        odometry: as received.
        smoother: of the correction.
        correction: (3,) the newest `map -> odom`, m and rad; None before the first.
        snapshot: the newest.
    """

    def __init__(self, rig: Rig, limits: LiveLimits) -> None:
        """Start without a sample."""
        self.inbox = Inbox((kind.counted for kind, _ in carried(rig)), limits, time.monotonic())
        self.odometry = ReceivedOdometry()
        self.smoother = Smoother(limits.correction_m_s, np.deg2rad(limits.correction_deg_s))
        self.correction: Array | None = None
        self.snapshot = empty_snapshot()

    @property
    def pose_map_odom(self) -> Array:
        """(3,) the newest correction; before the first, the map begins where the robot did."""
        return inverse(self.odometry.first) if self.correction is None else self.correction

    def report(self, state: str, now_s: float) -> LiveReport:
        """How it is doing, at a time of the wall clock, s."""
        inbox, lag_s = self.inbox, self.inbox.lag_s(now_s)
        return LiveReport(
            state,
            {name: source.count for name, source in inbox.sources.items()},
            {name: dict(source.left_out) for name, source in inbox.sources.items() if source.left_out},
            lag_s,
            max(lag_s, inbox.largest_lag_s),
            inbox.waiting_s(now_s),
            len(self.snapshot.poses),
        )
