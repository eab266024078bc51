"""The study judges every log by one column: gains and delay, as `calibrate --out` writes them."""

import calibration_study
import pytest


def row(log, trained, gains, delay, length_m=16.8):
    return {"log": log, "trained": trained, "length_m": length_m, "gains_mean": gains, "delay_mean": delay}


def test_all_logs_are_judged_by_gains_and_delay():
    """A robot at 99.6 % with the gains and 101 % with the delay is no better, and a laser log at 61 and 57 % meets 60 %."""
    robots = [row(f"mrclam6-{k}", "reference", *pair) for k, pair in enumerate([(0.996, 1.01), (0.7, 0.8), (0.5, 0.6)], 1)]
    figures = {metric.name: metric for metric in calibration_study.judged([row("fr079", "joint", 0.61, 0.57), *robots])}
    assert figures["better/mrclam6-reference"].value == 2.0
    assert not figures["better/mrclam6-reference"].passed
    assert figures["end_error/mrclam6-reference"].value == pytest.approx(80.0)
    assert figures["end_error/fr079-16.8m-joint"].value == pytest.approx(57.0)
