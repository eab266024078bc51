"""Pools: every task once, mistakes told, workers that die replaced."""

import os
from collections.abc import Generator

import pytest

from hybridmap.study.pools import ATTEMPTS, LocalProcesses, Lost, ThisProcess
from tests.study import studies


@pytest.mark.parametrize("pool", [ThisProcess(), LocalProcesses(2)], ids=["here", "two processes"])
def test_every_task_has_one_outcome_and_a_mistake_is_told(pool):
    outcomes = dict(pool.run(studies.picky, [1, 3, 5, 7]))
    assert outcomes == {0: 2, 1: Lost("ValueError: not this one"), 2: 10, 3: 14}
    assert list(pool.run(studies.picky, [])) == []


def test_a_task_whose_worker_dies_is_given_to_another(tmp_path):
    (tmp_path / "3-a").touch()
    pool = LocalProcesses(2)
    outcomes = dict(pool.run(studies.deadly, [(number, str(tmp_path)) for number in range(6)]))
    assert outcomes == {number: 2 * number for number in range(6)}
    assert not list(tmp_path.iterdir())
    assert pool.pids == ()


def test_a_task_that_kills_every_worker_is_given_up_and_the_others_are_done(tmp_path):
    for attempt in range(ATTEMPTS + 1):
        (tmp_path / f"3-{attempt}").touch()
    outcomes = dict(LocalProcesses(2).run(studies.deadly, [(number, str(tmp_path)) for number in range(5)]))
    assert outcomes.pop(3) == Lost(f"{ATTEMPTS} workers died of it")
    assert outcomes == {0: 0, 1: 2, 2: 4, 4: 8}
    assert len(list(tmp_path.iterdir())) == 1


def test_workers_have_one_thread_each_whatever_the_parent_has(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert list(LocalProcesses(1).run(studies.threads, [0])) == [(0, "11")]
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_workers_end_when_nobody_listens_any_more():
    pool = LocalProcesses(2)
    running = pool.run(studies.double, list(range(50)))
    next(running)
    pids = pool.pids
    assert len(pids) == 2
    assert isinstance(running, Generator)
    running.close()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
