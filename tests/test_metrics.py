"""Process time by stage, and the list of figures."""

import time
from pathlib import Path

import pytest

from hybridmap.metrics import FIGURES, StageClock, figure

FORMATS = Path(__file__).parents[1] / "docs" / "formats.md"


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


def test_a_figure_has_its_unit_and_words_from_the_list() -> None:
    found = figure("ate_poses_online/gtsam-gnc", 12, total=20, when="at the time")
    assert (found.name, found.value, found.unit) == ("ate_poses_online/gtsam-gnc", 12.0, "1")
    assert found.description == "poses compared, of 20; at the time"
    assert figure("loops_rejected", 1).description != figure("loops_rejected/gtsam-gnc", 1).description
    with pytest.raises(KeyError):
        figure("chi2", 1.0)  # is of a back-end


@pytest.mark.parametrize("measure", FIGURES)
def test_every_figure_of_the_list_is_documented(measure: str) -> None:
    text = FORMATS.read_text(encoding="utf-8")
    assert f"`{measure.rstrip('/')}" in text
