"""The list of what the paper has, its equations, and the figures that its texts name."""

import base64
import math
from dataclasses import replace

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.errors import ConfigError
from hybridmap.reproduction import equations as table
from hybridmap.reproduction.cells import End, ends
from hybridmap.reproduction.equations import equations
from hybridmap.reproduction.facts import NOT_RUN, Facts, facts_of
from hybridmap.reproduction.figures import errors_figure, maps_figure
from hybridmap.reproduction.page import SECTIONS, system_cells
from hybridmap.reproduction.paper import CELL_TYPES, EQUATIONS, OPEN_PARAMETERS, PARAMETERS, PARTS, RESULTS, Status
from hybridmap.reproduction.reproduction import plan
from hybridmap.reproduction.systems import BASELINES, SYSTEMS, results_of
from hybridmap.study import StudyConfig
from hybridmap.study.drive import MappedDrive
from hybridmap.study.frozen import Mapped
from hybridmap.study.model import SyntheticConfig
from hybridmap.study.pools import ThisProcess
from hybridmap.study.sources import laps
from hybridmap.study.study import run_study

MAPPED_BACKENDS = [{"backend": "odometry", "way": "mapped"}, {"name": "map", "backend": "primary", "way": "mapped"}]
ENDS = {1: End((16.8, 0.0), (16.7, 0.5), (16.7, 0.5))}


def test_whatever_is_not_done_says_why_and_where_it_is_shown():
    for item in (*RESULTS, *PARTS):
        assert (item.status is Status.DONE) == (not item.why), item.what
        assert item.shown in SECTIONS or (item.status is Status.MISSING and not item.shown), item.what
    for equation in equations():
        assert (equation.status is Status.DONE) == (not equation.why), equation.number


def test_the_paper_s_sixteen_equations_are_there():
    numbers = {int(number) for equation in equations() for number in equation.number.split(",")}
    assert numbers == set(range(1, 17))


def test_a_table_with_other_equations_is_one_clear_error(monkeypatch):
    monkeypatch.setattr(table, "EQUATIONS", EQUATIONS[:-1])
    with pytest.raises(ConfigError, match=r"paper\.md: found the equations 1; .* expected those of reproduction/paper\.py"):
        equations()


def test_ends_of_other_settings_are_not_used_again(tmp_path, monkeypatch):
    before = ends(tmp_path, [1])
    load = Config.load
    short = {"simulation.duration_s": 10.0}
    monkeypatch.setattr(Config, "load", lambda name, changed=None: load(name, (changed or {}) | short))
    assert ends(tmp_path, [1]) != before


def test_a_system_that_diverged_is_said_to_have_no_map(tmp_path, monkeypatch):
    clean = laps(SyntheticConfig(nodes=40, per_lap=16), 3)
    figures, poses = {"ate_m": 0.5}, clean.reference
    both, name = ("odometry", "relaxation-paper"), "relaxation-paper"
    mapped = Mapped(name, dict.fromkeys(both, figures), {}, dict.fromkeys(both, poses), {name: ("diverged", "away")})
    drive = replace(clean, mapped=mapped)
    monkeypatch.setattr(MappedDrive, "make", lambda _: drive)
    source = {"name": "lab by paper", "simulated": "lab", "config": "paper"}
    tree = {"name": "mine", "seeds": [1], "sources": [source], "backends": MAPPED_BACKENDS}
    (one,) = results_of(run_study(StudyConfig.from_tree(tree, "mine.yaml", tmp_path), tmp_path / "study", ThisProcess()))
    assert (set(one.lost), one.drives, one.ratio.value) == ({1}, 1, 1.0)
    assert one.without_map
    assert one.without_map in system_cells(one)[2]
    assert one.without_map in facts_of([], [one], ENDS)["ate lab paper"]
    shown = [maps_figure("lab", {"paper": one}) for one in (drive, replace(drive, mapped=replace(mapped, lost={})))]
    assert ["only odometry" in base64.b64decode(uri.partition(",")[2]).decode() for uri in shown] == [True, False]
    assert errors_figure([one])


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
