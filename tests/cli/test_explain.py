from __future__ import annotations

import json
import sqlite3
import sys

import pytest

from hybridmap.cli import main
from tests.store.sessions import ring_map, write_session

NODES_BY_TRAVEL = "nodes: {rule: travel, distance_m: 0.1, angle_deg: 15.0}"


@pytest.fixture
def run(monkeypatch, capsys):
    def call(*arguments: object) -> tuple[str | int | None, str, str]:
        monkeypatch.setattr(sys, "argv", ["hybridmap", "explain", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        shown = capsys.readouterr()
        return stopped.value.code, shown.out, shown.err

    return call


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return write_session(tmp_path_factory.mktemp("explain") / "s", ring_map(false_loop=True)).path


def test_a_node_is_told_in_words(run, session):
    code, out, err = run(session, "--node", 59)
    assert (code, err) == (0, "")
    assert out.startswith("node 59 at 59.000 s (stamp 59.000000000 s)")
    assert "nearest      of the older nodes on the final map: 19, 0.00 m" in out
    assert "loops to older nodes: 2 accepted, 1 rejected" in out
    assert "REJECTED  matches 8 < 12" in out
    assert out.count("proposed   by their profiles") == 1
    assert "off by     3.804 m" in out


def test_the_first_node_has_no_chain_and_no_older_nodes(run, session):
    out = run(session, "--node", 0)[1]
    assert "chain" not in out
    assert "loops to older nodes: none was considered: it is the first node" in out


def test_newer_nodes_are_told_too_but_not_all(run, session):
    out = run(session, "--node", 19)[1]
    assert "loops from newer nodes: " in out
    assert "    59  ACCEPTED" in out


def test_a_frame_between_nodes_says_why_none_was_made(run, session):
    out = run(session, "--frame", 12.34)[1]
    assert out.startswith("frame at 12.300 s")
    assert "node 13 came at 13.000 s" in out
    assert "no node" in out
    assert "loops to older" not in out
    assert "loops to older" in run(session, "--frame", 12.0)[1]


def test_a_frame_says_in_the_same_figures_what_kept_a_node_from_being_made(run, tmp_path):
    session = write_session(tmp_path / "s", ring_map(), keyframes=False)
    with sqlite3.connect(session.map_db) as connection:
        connection.execute("UPDATE info SET value = ? WHERE key = 'config_yaml'", (json.dumps(NODES_BY_TRAVEL),))
    connection.close()
    far, near = (run(session.path, "--frame", time_s)[1] for time_s in (12.5, 12.1))
    moved = "0.157 m and 4.8 deg"
    assert far.count(moved) == 2
    assert f"no view at this instant, though {moved} since the last node" in far
    assert "only 0.031 m and 1.0 deg since the last node; a node is made every 0.1 m" in near
    assert "no view" not in near


def test_json_is_one_object(run, session):
    code, out, _ = run(session, "--frame", 59, "--json")
    tree = json.loads(out)
    assert code == 0
    assert tree["primary_backend"] == "gtsam-lm"
    assert tree["frame"]["made_node"] is True
    assert [row["target"] for row in tree["node"]["loops"]] == [19, 29, 3]
    assert [row["proposed_by"] for row in tree["node"]["loops"]] == ["profile", None, None]
    assert tree["metrics"] == []
    assert "node" not in json.loads(run(session, "--frame", 12.5, "--json")[1])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--node", 60], "node 60 does not exist; expected one of 0..59"),
        (["--frame", 90], "no frame at 90 s; expected 0..59.400 s"),
        (["--frame", "nan"], "no frame at nan s; expected 0..59.400 s"),
        (["--frame", "inf"], "no frame at inf s; expected 0..59.400 s"),
        (["--frame", "1e200"], "no frame at 1e+200 s; expected 0..59.400 s"),
        ([], "either --node N or --frame T"),
        (["--node", 1, "--frame", 2], "either --node N or --frame T"),
        (["--node", "x"], "--node"),
    ],
)
def test_bad_input_is_one_line_and_code_two(run, session, arguments, said):
    code, out, err = run(session, *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("hybridmap: error: ")
    assert said in err


def test_what_is_no_session_is_one_line(run, tmp_path):
    for folder in (tmp_path, tmp_path / "gone"):
        code, out, err = run(folder, "--node", 0)
        assert (code, out, err.count("\n")) == (2, "", 1)
