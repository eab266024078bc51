"""`hybridmap calibrate`: figures, the configuration it writes, and one line for what it cannot do."""

import json
import sys

import numpy as np
import pytest
import yaml

from hybridmap.calibration.gains import NEUTRAL
from hybridmap.cli import main
from hybridmap.config import Config
from hybridmap.trajectory import Trajectory, write_tum
from tests.calibration.drives import GAINS, drive, write_session


def run(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["hybridmap", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        main()
    printed = capsys.readouterr()
    return end.value.code or 0, printed.out, printed.err


@pytest.fixture(scope="module")
def one():
    return drive(np.random.default_rng(5))


@pytest.fixture(scope="module")
def session(one, tmp_path_factory):
    return write_session(tmp_path_factory.mktemp("calibrate") / "session", one, np.random.default_rng(0))


@pytest.mark.parametrize("estimator", ["alternating", "joint"])
def test_json_and_configuration(monkeypatch, capsys, session, tmp_path, estimator):
    out = tmp_path / "new" / "calibrated.yaml"
    code, printed, _ = run(monkeypatch, capsys, "calibrate", session, "--estimator", estimator, "--out", out, "--json")
    assert code == 0
    told = json.loads(printed)
    figures = {row["name"]: row["value"] for row in told["metrics"]}
    assert told["significant"] is True
    assert told["estimator"] == estimator
    assert figures["heading_bias/calibration"] == pytest.approx(GAINS.heading_bias_rad_m, abs=0.006)
    neural = Config.load(out).neural
    assert neural.gain == figures["gain/calibration"]
    assert neural.turn_gain == figures["turn_gain/calibration"]
    assert neural.heading_bias_rad_m == figures["heading_bias/calibration"]


def test_a_reference_and_a_table(monkeypatch, capsys, one, session, tmp_path):
    write_tum(tmp_path / "gt.tum", Trajectory(one.motion.stamps_ns, one.truth))
    code, printed, _ = run(monkeypatch, capsys, "calibrate", session, "--reference", tmp_path / "gt.tum")
    assert code == 0
    assert "heading_bias_sigma/calibration" in printed
    assert "by more than 3 sigma" in printed


def test_the_configuration_stays_where_nothing_is_significant(monkeypatch, capsys, tmp_path):
    right = drive(np.random.default_rng(6), gains=NEUTRAL)
    folder = write_session(tmp_path / "right", right, np.random.default_rng(0))
    code, printed, _ = run(monkeypatch, capsys, "calibrate", folder, "--out", tmp_path / "c.yaml", "--json")
    assert code == 0
    assert json.loads(printed)["significant"] is False
    assert "keep them" in json.loads(printed)["message"]
    assert Config.load(tmp_path / "c.yaml").neural == Config().neural
    assert yaml.safe_load((tmp_path / "c.yaml").read_text())["backends"]["names"] == ["gtsam-cauchy"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("calibrate", "nowhere"), "no such session folder"),
        (("calibrate", "SESSION", "--estimator", "magic"), "unknown estimator 'magic'; there are alternating, joint"),
        (("calibrate", "SESSION", "SESSION", "--estimator", "joint"), "the joint estimator takes one session, found 2"),
        (("calibrate", "SESSION", "--reference", "none.tum"), "none.tum: no such trajectory file"),
        (("calibrate", "SESSION", "--leg", "100"), "expected at least 400.0 m"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(monkeypatch, capsys, session, words, says):
    named = {"SESSION": session}
    code, printed, errors = run(monkeypatch, capsys, *(named.get(word, word) for word in words))
    assert (code, printed) == (2, "")
    assert errors.count("\n") == 1
    assert says in errors
