"""The list of what the paper has, its equations, and the figures that its texts name."""

import math

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.reproduction.cells import ends
from hybridmap.reproduction.equations import equations
from hybridmap.reproduction.facts import NOT_RUN, Facts
from hybridmap.reproduction.page import SECTIONS
from hybridmap.reproduction.paper import CELL_TYPES, OPEN_PARAMETERS, PARAMETERS, PARTS, RESULTS, Status
from hybridmap.reproduction.reproduction import plan
from hybridmap.reproduction.systems import BASELINES, SYSTEMS


def test_whatever_is_not_done_says_why_and_where_it_is_shown():
    for item in (*RESULTS, *PARTS):
        assert (item.status is Status.DONE) == (not item.why), item.what
        assert item.shown in SECTIONS or (item.status is Status.MISSING and not item.shown), item.what
    for equation in equations():
        assert (equation.status is Status.DONE) == (not equation.why), equation.number


def test_the_paper_s_sixteen_equations_are_there():
    numbers = {int(number) for equation in equations() for number in equation.number.split(",")}
    assert numbers == set(range(1, 17))


def test_its_parameters_are_settings_and_those_of_the_configuration_paper_are_the_paper_s():
    settings = Config.load("paper").model_dump()

    def value(key):
        found = settings
        for part in key.split("."):
            found = found[part]
        return found

    for parameter in PARAMETERS:
        numbers = [float(word) for word in parameter.paper.replace(",", "").split() if word[0].isdigit()]
        assert [value(key) for key in parameter.keys] == numbers, parameter.name
    for parameter in OPEN_PARAMETERS:
        for key in parameter.keys:
            value(key)


def test_every_system_of_the_study_is_described_and_compared():
    study = plan(2)
    assert study.seeds == (1, 2)
    assert {source.config for source in study.sources} <= set(SYSTEMS)
    assert {source.simulated for source in study.sources} == set(BASELINES)
    for world, others in BASELINES.items():
        assert others in SYSTEMS, world


def test_a_system_that_was_not_run_is_said_to_be_so_and_any_other_name_must_be_known():
    facts = Facts({"gridness": "1.3"})
    assert facts.fill("{gridness}, {ate office ratslam}") == f"1.3, {NOT_RUN}"
    with pytest.raises(KeyError):
        facts.fill("{gridnes}")


def test_the_network_ends_where_its_odometry_leads_it(tmp_path):
    found = ends(tmp_path, [1, 2])
    assert set(found) == {1, 2}
    for end in found.values():
        assert end.truth[0] == pytest.approx(16.8, abs=0.02)
        assert math.dist(end.network, end.odometry) < 1e-3
        assert 0.1 < math.dist(end.odometry, end.truth) < 5.0
    assert not np.allclose(found[1].odometry, found[2].odometry)
    assert ends(tmp_path, [2]) == {2: found[2]}


def test_cell_types_are_the_paper_s():
    assert [cell.cells for cell in CELL_TYPES] == ["head-direction cells", "band cells", "grid cells", "place cells"]
