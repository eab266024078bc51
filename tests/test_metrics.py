"""Process time by stage."""

import time

from hybridmap.metrics import StageClock


def busy(seconds):
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


def test_a_stage_within_another_counts_by_itself_alone():
    clock = StageClock()
    started = time.process_time()
    with clock.stage("outer"):
        busy(0.02)
        with clock.stage("inner"):
            busy(0.04)
        with clock.stage("inner"):
            busy(0.01)
    whole = time.process_time() - started
    assert 0.05 <= clock.cpu_s["inner"] < 0.07
    assert 0.02 <= clock.cpu_s["outer"] < 0.04
    assert sum(clock.cpu_s.values()) <= whole


def test_a_stage_that_fails_is_counted_too():
    clock = StageClock()
    try:
        with clock.stage("outer"), clock.stage("inner"):
            busy(0.01)
            raise ValueError
    except ValueError:
        pass
    with clock.stage("next"):
        busy(0.01)
    assert clock.cpu_s["inner"] >= 0.01 > clock.cpu_s["outer"]
    assert clock.cpu_s["next"] < 0.03
