"""Odometry that is stamped early is brought onto the views' clock before anything else."""

from itertools import chain

import numpy as np
import pytest

from hybridmap.streams.base import Sample, SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.synchronise import Synchroniser

MS = 1_000_000


def steps_with(delay_s):
    """Odometry every 100 ms at 1 m/s, scans between; in order of stamp, as a reader gives them."""
    samples: list[Sample] = [SelfMotion(k * 100 * MS, np.array([0.1 * k, 0.0, 0.0])) for k in range(20)]
    samples += [LaserScan(k * 100 * MS + 50 * MS, np.ones(3, np.float32)) for k in range(3, 15)]
    samples.sort(key=lambda sample: sample.stamp_ns)
    synchroniser = Synchroniser(odometry_delay_s=delay_s)
    steps = [step for sample in samples for step in synchroniser.push(sample)] + list(synchroniser.flush())
    return steps, synchroniser


@pytest.mark.parametrize("delay_s", [0.0, 0.13, -0.13])
def test_a_view_gets_the_odometry_of_its_own_instant(delay_s):
    steps, synchroniser = steps_with(delay_s)
    views = [step for step in steps if step.observation is not None]
    assert len(views) == 12
    for step in views:
        assert step.pose_odom_robot[0] == pytest.approx(step.stamp_ns / 1e9 - delay_s, abs=1e-9)
    stamps = [step.stamp_ns for step in steps]
    assert stamps == sorted(stamps)
    assert synchroniser.report.counts == {}


@pytest.mark.parametrize("late_s", [0.13, -0.13])
@pytest.mark.parametrize("latency_s", [0.0, 0.5])
def test_a_delay_that_becomes_known_on_the_way_holds_from_then_on(late_s, latency_s):
    """Odometry is `late_s` early; after the view at 1.05 s that is known. The steps do not depend on the latency."""
    samples: list[Sample] = [SelfMotion(k * 100 * MS, np.array([0.1 * k, 0.0, 0.0])) for k in range(40)]
    samples += [LaserScan(k * 100 * MS + 50 * MS, np.ones(3, np.float32)) for k in range(3, 30)]
    samples.sort(key=lambda sample: sample.stamp_ns)
    synchroniser, steps = Synchroniser(latency_s), []
    coming = (step for sample in samples for step in synchroniser.push(sample))
    for ready in chain(coming, synchroniser.flush()):
        steps.append(ready)
        if ready.stamp_ns == 1050 * MS:
            synchroniser.retime(late_s)
    views = [step for step in steps if step.observation is not None]
    assert [step.stamp_ns // MS for step in views] == [k * 100 + 50 for k in range(3, 30)]
    for step in views:
        if step.stamp_ns > 1050 * MS + 300 * MS:
            assert step.pose_odom_robot[0] == pytest.approx(step.stamp_ns / 1e9 - late_s, abs=1e-9)
    stamps = [step.stamp_ns for step in steps]
    assert stamps == sorted(stamps)
    assert sum(step.delta_robot[0] for step in steps) == pytest.approx(3.9)
    assert all(step.delta_robot[0] >= 0.0 for step in steps)
    assert synchroniser.report.counts == {}
