"""Order, lateness and overload, with a clock that the test sets."""

import itertools
import math

import numpy as np
import pytest

from hybridmap.live.doctor import sentences
from hybridmap.live.inbox import AHEAD, LATE, LONGEST_WAIT_S, ODOMETRY, PAUSED, SLOW, Inbox, LiveLimits
from hybridmap.streams.base import Observation, SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.order import sort_key
from hybridmap.trajectory import stamp_ns_from_s

RANGES = np.ones(3, np.float32)
PATIENT = LiveLimits(lag_s=math.inf)


def motion(stamp_s):
    return SelfMotion(stamp_ns_from_s(stamp_s), np.zeros(3))


def scan(stamp_s):
    return LaserScan(stamp_ns_from_s(stamp_s), RANGES)


def every(make, period_s, end_s, start_s=0.0, delay_s=0.0):
    """Samples and when they come, s."""
    return [(stamp_s + delay_s, make(stamp_s)) for stamp_s in np.arange(start_s, end_s, period_s).round(6)]


class SlowMapper:
    """Maps each view in a given time, or in the times of a list again and again; everything is simulated."""

    def __init__(self, inbox, view_s):
        self.inbox, self.times_s = inbox, itertools.cycle(np.atleast_1d(view_s).tolist())
        self.pipe, self.got, self.lags = [], [], []
        self.now_s, self.free_s, self.busy_s, self.consumed = 0.0, None, 0.0, 0

    def run_until(self, now_s):
        """Let time pass up to `now_s`."""
        while self.free_s is not None and self.free_s <= now_s:
            self.now_s, self.free_s = max(self.free_s, self.now_s), None
            self.consumed += 1
            self.lags.append(self.inbox.lag_s(self.now_s))
            self.inbox.done(self.consumed, 1, self.busy_s, 0.0, self.now_s)
            self.work()
        self.now_s = now_s

    def work(self):
        """Take what there is, up to the next view that needs time."""
        self.pipe += self.inbox.take(self.now_s)
        while self.pipe and self.free_s is None:
            self.got.append(self.pipe.pop(0))
            if isinstance(self.got[-1], Observation):
                self.busy_s = next(self.times_s)
                self.free_s = self.now_s + self.busy_s
                self.pipe += self.inbox.take(self.now_s)
            else:
                self.consumed += 1

    def feed(self, arrivals):
        for now_s, sample in sorted(arrivals, key=lambda row: row[0]):
            self.run_until(now_s)
            self.inbox.add(sample, now_s)
            self.work()
            self.run_until(now_s)
            self.lags.append(self.inbox.lag_s(now_s))
        return self


def mapped(arrivals, views=("scans",), limits=PATIENT, view_s=0.0):
    inbox = Inbox(views, limits, 0.0)
    mapper = SlowMapper(inbox, view_s).feed(arrivals)
    return inbox, mapper, [*mapper.got, *mapper.pipe, *inbox.flush(mapper.now_s)]


def in_order(arrivals):
    return sorted((sample for _, sample in arrivals), key=sort_key)


@pytest.mark.parametrize("delay_s", [0.0, 0.07, 0.31, 0.9])
@pytest.mark.parametrize("late", [motion, scan])
def test_order_is_that_of_stamps_whichever_source_is_late(late, delay_s):
    arrivals = every(motion, 0.02, 6.0, delay_s=delay_s * (late is motion)) + every(
        scan, 0.1, 6.0, delay_s=delay_s * (late is scan)
    )
    inbox, _, got = mapped(arrivals)
    assert got == in_order(arrivals)
    assert not inbox.left_out


def test_motion_comes_before_a_view_of_the_same_stamp_whichever_comes_first():
    for arrivals in ([(0.0, motion(0.0)), (1.0, scan(1.0)), (1.1, motion(1.0))], [(1.0, motion(1.0)), (1.1, scan(1.0))]):
        _, _, got = mapped(arrivals)
        assert got == in_order(arrivals)


def test_views_before_the_first_odometry_wait_for_it():
    arrivals = every(scan, 0.1, 6.0) + every(motion, 0.02, 6.0, start_s=3.0)
    _, _, got = mapped(arrivals)
    assert got == in_order(arrivals)


def test_a_camera_that_comes_up_seconds_after_the_wheels_is_waited_for():
    arrivals = every(motion, 0.02, 12.0) + every(scan, 0.1, 12.0, start_s=5.0, delay_s=0.3)
    inbox, _, got = mapped(arrivals)
    assert got == in_order(arrivals)
    assert not inbox.left_out


def test_a_sensor_that_never_comes_holds_up_the_first_seconds_alone():
    inbox, mapper, _ = mapped(every(motion, 0.02, 20.0))
    assert len(mapper.got) == 1000
    before = Inbox(["scans"], PATIENT, 0.0)
    assert not SlowMapper(before, 0.0).feed(every(motion, 0.02, LONGEST_WAIT_S - 0.1)).got
    assert not inbox.left_out


def test_a_source_that_falls_silent_is_given_up_after_its_patience_and_taken_back():
    silent = every(scan, 0.1, 5.0, delay_s=0.05) + every(scan, 0.1, 20.0, start_s=10.0, delay_s=0.05)
    inbox, mapper, got = mapped(every(motion, 0.02, 20.0) + silent)
    assert len(mapper.got) > 1140
    assert sum(isinstance(sample, SelfMotion) for sample in got) == 1000
    assert inbox.left_out == {("scans", LATE): 1}  # stamped before odometry that no longer waited for it


def test_a_slow_sensor_is_given_the_time_that_it_needs():
    arrivals = every(motion, 0.02, 30.0) + every(scan, 2.0, 30.0, delay_s=0.5)
    inbox, _, got = mapped(arrivals)
    assert got == in_order(arrivals)
    assert not inbox.left_out


def test_where_everything_stands_still_nobody_is_given_up():
    arrivals = every(motion, 0.02, 5.0) + every(scan, 0.1, 5.0, delay_s=0.25)
    pause = [(at_s + 60.0 * (at_s > 3.0), sample) for at_s, sample in arrivals]
    inbox, _, got = mapped(pause)
    assert got == in_order(arrivals)
    assert not inbox.left_out


@pytest.mark.parametrize(("lag_s", "period_s"), [(0.5, 0.05), (2.0, 0.1)])
def test_a_machine_that_is_too_slow_keeps_up_by_leaving_out_views(lag_s, period_s):
    arrivals = every(motion, 0.02, 60.0) + every(scan, period_s, 600 * period_s, delay_s=0.03)
    inbox, mapper, got = mapped(arrivals, limits=LiveLimits(lag_s=lag_s), view_s=3.0 * period_s)
    assert max(mapper.lags) <= lag_s
    assert inbox.largest_lag_s <= lag_s
    dropped = inbox.left_out.pop(("scans", SLOW))
    assert set(inbox.left_out) == {("scans", SLOW)}
    assert len(got) == len(arrivals) - dropped
    assert 350 < dropped < 450
    assert sum(isinstance(sample, SelfMotion) for sample in got) == 3000
    assert got == sorted(got, key=sort_key)
    assert sum(isinstance(sample, LaserScan) for sample in got) == 600 - dropped
    kept = np.array([sample.stamp_ns / 1e9 for sample in got if isinstance(sample, LaserScan)])
    gaps = np.diff(kept) / period_s
    assert gaps.max() <= 8.0  # not one gap of all that waited, which are 10 or 20
    assert gaps[len(gaps) // 4 : -20].mean() == pytest.approx(3.0, abs=0.3)
    assert any(f"scans: {dropped} of 600 left out" in one for one in sentences(inbox, 60.0))


def test_single_steps_that_take_long_are_allowed_for():
    """Every seventh step takes half the limit: what it holds up is left out in time, once its length is known."""
    arrivals = every(motion, 0.02, 120.0) + every(scan, 0.1, 120.0, delay_s=0.03)
    inbox, mapper, got = mapped(arrivals, limits=LiveLimits(), view_s=[0.25] * 6 + [1.2])
    assert inbox.largest_lag_s == max(mapper.lags) <= 2.0
    assert sum(isinstance(sample, LaserScan) for sample in got) == 1200 - inbox.left_out["scans", SLOW]
    assert sum(isinstance(sample, LaserScan) for sample in mapper.got) > 280  # 7 views need 2.7 s: it is never idle for long


def test_a_view_that_waits_for_odometry_is_said_and_is_no_lag():
    """The mapper takes it in, and has it on the map only after the odometry that follows."""
    inbox = Inbox(["scans"], LiveLimits(), 0.0)
    for now_s, sample in ((0.0, motion(0.0)), (0.1, scan(0.1)), (0.6, motion(0.1))):
        inbox.add(sample, now_s)
    assert inbox.waiting_s(0.6) == 0.0
    assert len(inbox.take(0.7)) == 3
    assert inbox.lag_s(0.9) == pytest.approx(0.3)
    inbox.done(3, 0, 0.0, 0.0, 1.0)
    assert inbox.lag_s(5.0) == 0.0
    assert inbox.waiting_s(5.0) == pytest.approx(4.9)
    for now_s, sample in ((5.0, motion(0.12)), (5.1, scan(0.2))):
        inbox.add(sample, now_s)
    inbox.take(5.2)
    assert inbox.lag_s(5.5) == pytest.approx(0.4)  # since odometry that came at 5.0 s had its turn, with the scan of 5.1 s
    assert inbox.waiting_s(5.5) == pytest.approx(0.4)
    inbox.done(4, 1, 0.3, 0.0, 5.6)
    assert inbox.lag_s(6.0) == 0.0
    assert inbox.waiting_s(6.0) == pytest.approx(0.9)


def test_a_machine_that_is_fast_enough_leaves_nothing_out():
    arrivals = every(motion, 0.02, 60.0) + every(scan, 0.1, 60.0, delay_s=0.03)
    inbox, _, got = mapped(arrivals, limits=LiveLimits(), view_s=0.08)
    assert got == in_order(arrivals)
    assert not inbox.left_out


def test_the_newest_view_is_the_one_that_is_kept():
    _, _, got = mapped(every(motion, 0.02, 5.0) + every(scan, 0.1, 5.0), limits=LiveLimits(lag_s=1.0), view_s=100.0)
    first, in_pipe, *kept = [sample.stamp_ns / 1e9 for sample in got if isinstance(sample, LaserScan)]
    assert (first, in_pipe, kept[-1]) == (0.0, 0.1, 4.9)
    assert kept[0] > 3.8


def test_what_is_mapped_after_the_drive_is_no_lag():
    inbox, mapper, _ = mapped(every(motion, 0.02, 3.0) + every(scan, 0.1, 3.0), view_s=0.2)
    assert inbox.largest_lag_s > 1.0
    assert inbox.lag_s(100.0) == 0.0
    inbox.done(1, 1, 0.2, 0.0, 100.0)
    assert inbox.largest_lag_s <= mapper.now_s


def test_paused_views_are_left_out_and_odometry_goes_on():
    inbox = Inbox(["scans"], PATIENT, 0.0)
    inbox.paused = True
    mapper = SlowMapper(inbox, 0.0).feed(every(motion, 0.02, 5.0) + every(scan, 0.1, 5.0))
    assert inbox.left_out == {("scans", PAUSED): 50}
    assert len(mapper.got) == 246  # up to the newest scan


def test_one_stamp_far_ahead_costs_one_sample():
    arrivals = every(motion, 0.02, 30.0) + every(scan, 0.1, 30.0)
    for wrong in (motion(1000.0), scan(1000.0)):
        inbox, _, got = mapped([*arrivals, (3.001, wrong)])
        assert got == in_order(arrivals)
        assert sum(inbox.left_out.values()) == 1


def test_a_clock_that_is_set_back_is_said_and_leaves_out_what_would_go_back(caplog):
    back = [(at_s, type(s)(s.stamp_ns - stamp_ns_from_s(100.0), RANGES)) for at_s, s in every(motion, 0.02, 20.0, start_s=10.0)]
    inbox, _, got = mapped(every(motion, 0.02, 10.0) + every(scan, 0.1, 20.0) + back)
    assert got == sorted(got, key=sort_key)
    assert inbox.left_out[ODOMETRY, LATE] == 500
    assert [record.getMessage() for record in caplog.records] == ["odometry: stamps went back by 99.980 s to -90.000000000 s"]
    assert any("stamps went back by 99.980 s" in one and "reset" in one for one in sentences(inbox, 20.0))


def test_views_on_another_clock_are_bounded_and_said():
    shifted = [(at_s, scan(at_s + 500.0)) for at_s, _ in every(scan, 0.1, 30.0)]
    inbox, mapper, _ = mapped(every(motion, 0.02, 30.0) + shifted)
    assert not any(isinstance(sample, LaserScan) for sample in mapper.got)
    assert inbox.left_out["scans", AHEAD] > 190
    said = sentences(inbox, 30.0)
    assert any("scans: stamps are 500.0" in one and "later" in one for one in said)


def test_the_doctor_names_what_is_missing_and_is_content_otherwise():
    inbox, _, _ = mapped(every(motion, 0.02, 8.0))
    assert [one.split(":")[0] for one in sentences(inbox, 8.0)] == ["scans"]
    assert "none came in 8 s" in sentences(inbox, 8.0)[0]
    inbox, _, _ = mapped(every(scan, 0.1, 8.0))
    assert [one.split(":")[0] for one in sentences(inbox, 8.0)] == ["odometry"]
    inbox, _, _ = mapped(every(scan, 0.1, 8.0) + every(motion, 0.02, 8.0, delay_s=0.2))
    assert sentences(inbox, 8.0) == []
    assert [one.split(":")[0] for one in sentences(inbox, 20.0)] == ["odometry", "scans"]
    assert sentences(Inbox(["scans"], PATIENT, 0.0), 2.0) == []
