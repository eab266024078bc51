"""`hybridmap calibrate`: figures, the configuration it writes, and one line for what it cannot do."""

import json
import sys

import numpy as np
import pytest
import yaml

from hybridmap.cli import main
from hybridmap.config import Config
from hybridmap.odometry_model import NEUTRAL
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


def test_the_delay_in_use_is_added_to(monkeypatch, capsys, one, tmp_path):
    """Poses stamped 0.1 s late are a delay of 0.1 s more than the one in use."""
    late = Trajectory(one.motion.stamps_ns + 100_000_000, one.truth)
    write_tum(tmp_path / "late.tum", late)
    folder = write_session(tmp_path / "s", one, np.random.default_rng(0), sensors="{odometry_delay_s: 0.25}")
    words = ("calibrate", folder, "--reference", tmp_path / "late.tum", "--out", tmp_path / "c.yaml", "--json")
    code, printed, _ = run(monkeypatch, capsys, *words)
    assert code == 0
    delay = next(row["value"] for row in json.loads(printed)["metrics"] if row["name"] == "delay/calibration")
    assert delay == pytest.approx(0.1, abs=0.03)
    assert Config.load(tmp_path / "c.yaml").sensors.odometry_delay_s == pytest.approx(0.25 + delay)


def test_a_file_that_is_there_is_replaced_only_when_asked(monkeypatch, capsys, session, tmp_path):
    out = tmp_path / "kept.yaml"
    out.write_text("mine")
    code, printed, errors = run(monkeypatch, capsys, "calibrate", session, "--out", out)
    assert (code, printed, out.read_text()) == (2, "", "mine")
    assert "exists already; choose another name or give --overwrite" in errors
    assert run(monkeypatch, capsys, "calibrate", session, "--out", out, "--overwrite")[0] == 0
    assert Config.load(out).neural.gain != 1.0
    code, _, errors = run(monkeypatch, capsys, "calibrate", session, "--out", tmp_path, "--overwrite")
    assert (code, errors.count("\n")) == (2, 1)
    assert f"{tmp_path}: is a folder; name a file" in errors


def test_what_does_not_load_is_not_written(monkeypatch, capsys, one, tmp_path):
    write_tum(tmp_path / "late.tum", Trajectory(one.motion.stamps_ns + 100_000_000, one.truth))
    folder = write_session(tmp_path / "s", one, np.random.default_rng(0), sensors="{odometry_delay_s: 0.95}")
    words = ("calibrate", folder, "--reference", tmp_path / "late.tum", "--out", tmp_path / "c.yaml")
    code, printed, errors = run(monkeypatch, capsys, *words)
    assert (code, printed) == (2, "")
    assert "not written: sensors.odometry_delay_s" in errors
    assert not (tmp_path / "c.yaml").exists()


def test_two_configurations_have_no_common_one_to_write(monkeypatch, capsys, session, tmp_path):
    other = drive(np.random.default_rng(6))
    folder = write_session(tmp_path / "b", other, np.random.default_rng(0), sensors="{range_max_m: 9.0}")
    code, printed, errors = run(monkeypatch, capsys, "calibrate", session, folder, "--out", tmp_path / "c.yaml")
    assert (code, printed) == (2, "")
    assert "its configuration has sensors.range_max_m 9.0" in errors


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("calibrate", "nowhere"), "no such session folder"),
        (("calibrate", "SESSION", "--estimator", "magic"), "unknown estimator 'magic'; there are alternating, joint"),
        (("calibrate", "SESSION", "SESSION", "--estimator", "joint"), "the joint estimator takes one session, found 2"),
        (("calibrate", "SESSION", "SESSION"), "give each drive once"),
        (("calibrate", "SESSION", "--reference", "x.tum", "--estimator", "magic"), "unknown estimator 'magic'"),
        (("calibrate", "SESSION", "--reference", "x.tum", "--estimator", "joint"), "and a reference are given"),
        (("calibrate", "SESSION", "--estimator", "joint", "--leg", "4"), "--leg cannot be used with the estimator `joint`"),
        (("calibrate", "SESSION", "--leg", "0"), "--leg: found 0 m, expected 0.1 m or more"),
        (("calibrate", "SESSION", "--leg", "-1"), "--leg: found -1 m, expected 0.1 m or more"),
        (("calibrate", "SESSION", "--leg", "nan"), "--leg: found nan m, expected 0.1 m or more"),
        (("calibrate", "SESSION", "--reference", "none.tum"), "none.tum: no such trajectory file"),
        (("calibrate", "SESSION", "--leg", "100"), "expected at least 8 pieces and 400.0 m"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(monkeypatch, capsys, session, words, says):
    named = {"SESSION": session}
    code, printed, errors = run(monkeypatch, capsys, *(named.get(word, word) for word in words))
    assert (code, printed) == (2, "")
    assert errors.count("\n") == 1
    assert says in errors
