"""A study that is stopped at any moment goes on, with the same tables as if nothing had been."""

import json
import multiprocessing
import time
from dataclasses import replace

import pytest

from hybridmap import provenance
from hybridmap.errors import OutputError, StudyError
from hybridmap.output import held
from hybridmap.report.study_page import write_study_page
from hybridmap.study import cell as cells
from hybridmap.study import runner
from hybridmap.study.folder import STUDY_FOLDER
from hybridmap.study.pools import LocalProcesses, Lost, ThisProcess
from hybridmap.study.study import run_study
from tests.study.studies import small

TABLES = ("cells.csv", "summary.csv", "metrics.json", "study.yaml")


def tables(done):
    return {name: (done.folder.path / name).read_bytes() for name in TABLES}


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    done = run_study(small(), tmp_path_factory.mktemp("study") / "alone", ThisProcess())
    return done, tables(done)


@pytest.fixture(scope="module")
def page(alone):
    return write_study_page(alone[0]).read_text()


class StopsAfter(ThisProcess):
    """A pool that is interrupted."""

    def __init__(self, count):
        self.left = count

    def run(self, work, tasks):
        for outcome in super().run(work, tasks):
            if self.left == 0:
                raise KeyboardInterrupt
            self.left -= 1
            yield outcome


def test_every_cell_has_its_line_and_nothing_is_computed_twice(alone, tmp_path):
    done, told = alone
    assert done.computed == 18
    lines = told["cells.csv"].decode().splitlines()
    assert len(lines) == 19
    assert lines[0].startswith("source,setting,false_loop_kind,false_loop_rate,seed,backend,start,status,ate_m,")
    assert lines[1].startswith("laps,default,,0,3,gtsam-lm,own,converged,0.0")
    assert b"cpu" not in told["cells.csv"] + told["metrics.json"] + told["summary.csv"]
    assert (done.folder.path / "timings.csv").read_text().count("\n") == 19
    again = run_study(small(), done.folder.path, ThisProcess())
    assert again.computed == 0
    assert tables(again) == told


def test_a_study_that_is_stopped_twice_gives_the_same_bytes(alone, page, tmp_path):
    for count in (1, 7):  # the first one while the graphs are made
        with pytest.raises(KeyboardInterrupt):
            run_study(small(), tmp_path, StopsAfter(count))
        assert not (tmp_path / "cells.csv").exists()
    kept = sorted((tmp_path / "cells").glob("*/*.json"))
    assert len(kept) == 6
    kept[0].write_text(kept[0].read_text()[:20])  # as a loss of power leaves it
    kept[1].write_text("{}")
    (kept[2].parent / f".{kept[2].name}.partial").write_text("{")
    (graph,) = sorted((tmp_path / "sources").glob("*.npz"))[:1]
    graph.write_bytes(graph.read_bytes()[:-30])
    done = run_study(small(), tmp_path, ThisProcess())
    assert done.computed == 18 - 4
    assert tables(done) == alone[1]
    assert write_study_page(done).read_text() == page
    assert not list(tmp_path.rglob("*.partial"))


def test_a_study_whose_process_is_killed_gives_the_same_bytes(alone, tmp_path):
    run = multiprocessing.get_context("spawn").Process(target=run_study, args=(small(), tmp_path, ThisProcess()))
    run.start()
    while run.is_alive() and len(list((tmp_path / "cells").glob("*/*.json"))) < 3:
        time.sleep(0.01)
    run.kill()
    run.join()
    done = run_study(small(), tmp_path, ThisProcess())
    assert done.computed <= 18 - 3
    assert tables(done) == alone[1]


def test_two_processes_give_the_same_bytes(alone, tmp_path):
    assert tables(run_study(small(), tmp_path, LocalProcesses(2))) == alone[1]


def test_a_changed_study_keeps_old_cells_and_never_shows_them(alone, tmp_path):
    run_study(small(), tmp_path, ThisProcess())
    changed = {"false_loops": {"rates": [0.0, 0.2]}}
    done = run_study(small(**changed), tmp_path, ThisProcess())
    assert (len(done.grid.cells), done.computed) == (12, 6)
    assert ",0.3," not in (tmp_path / "cells.csv").read_text()
    back = run_study(small(), tmp_path, ThisProcess())
    assert back.computed == 0
    assert tables(back) == alone[1]


def test_results_of_other_code_are_not_taken(alone, tmp_path, monkeypatch):
    run_study(small(), tmp_path, ThisProcess())
    monkeypatch.setattr(provenance, "solving", lambda: "of another version")
    assert run_study(small(), tmp_path, ThisProcess()).computed == 18


def test_a_worker_of_another_version_ends_the_study(tmp_path, monkeypatch):
    class Elsewhere(ThisProcess):
        def run(self, work, tasks):
            for index, outcome in super().run(work, tasks):
                assert not isinstance(outcome, Lost)
                yield index, replace(outcome, code="another")

    with pytest.raises(StudyError, match="another version of hybridmap"):
        run_study(small(), tmp_path, Elsewhere())
    assert not list((tmp_path / "cells").glob("*/*.json"))


def test_a_mistake_of_ours_is_a_row_and_tried_again(alone, tmp_path, monkeypatch):
    run_one = cells.run

    def sometimes(task):
        if task.variant.backend == "odometry" and task.rate > 0.0:
            raise ZeroDivisionError("oh\nno")
        return run_one(task)

    monkeypatch.setattr(cells, "run", sometimes)
    done = run_study(small(), tmp_path, ThisProcess())
    assert done.head["status"] == {"converged": 14, runner.CRASHED: 4}
    assert "ZeroDivisionError: oh no" in (tmp_path / "cells.csv").read_text()
    assert "ZeroDivisionError: oh no" in write_study_page(done).read_text()
    monkeypatch.setattr(cells, "run", run_one)
    healed = run_study(small(), tmp_path, ThisProcess())
    assert healed.computed == 4
    assert tables(healed) == alone[1]


def test_a_source_that_fails_is_a_status_of_its_cells_and_the_others_go_on(tmp_path):
    sources = [{"name": "laps", "synthetic": {"nodes": 40, "per_lap": 16}}, {"simulated": "lab", "end_s": 0.2}]
    done = run_study(small(sources=sources, seeds=[3], false_loops={}), tmp_path, ThisProcess())
    assert done.head["status"] == {"converged": 3, "unmapped": 3}
    page = write_study_page(done).read_text()
    said = '<tr><td>unmapped</td><td>lab/default</td><td>every one</td><td class="n">3</td>'
    assert (page.count("<td>unmapped</td>"), page.count(said)) == (1, 1)


def hold(path, ready, done):
    with held(path, STUDY_FOLDER):
        ready.set()
        done.wait(30)


def test_a_folder_is_used_by_one_run_at_a_time_and_by_nothing_else(tmp_path):
    context = multiprocessing.get_context("fork")
    ready, done = context.Event(), context.Event()
    other = context.Process(target=hold, args=(tmp_path / "study", ready, done))
    other.start()
    assert ready.wait(30)
    with pytest.raises(OutputError, match="another run"):
        run_study(small(), tmp_path / "study", ThisProcess())
    other.kill()  # a killed run holds nothing
    other.join()
    assert run_study(small(), tmp_path / "study", ThisProcess()).computed == 18
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"it holds 'mine.txt'"):
        run_study(small(), tmp_path, ThisProcess())
    with pytest.raises(OutputError, match="is a file"):
        run_study(small(), tmp_path / "mine.txt", ThisProcess())


def test_progress_reaches_its_end(tmp_path):
    seen = []
    run_study(small(), tmp_path, ThisProcess(), lambda done, total: seen.append((done, total)))
    assert seen[0] == (0, 20)  # 18 cells and 2 graphs
    assert seen[-1] == (20, 20)
    assert seen == sorted(seen)


def test_figures_are_in_the_house_s_shape(alone):
    told = json.loads(alone[1]["metrics.json"])
    assert told["baseline"] == "gtsam-lm"
    assert told["cells"] == 18
    rows = {row["name"]: row for row in told["metrics"]}
    one = rows["ate_difference/laps/default/random 30 %/odometry"]
    assert one["unit"] == "m"
    assert one["description"].endswith("2 values: no interval")  # of two seeds
    assert rows["false_kept_median/laps/default/random 30 %/gtsam-lm"]["value"] == 10


def test_the_page_needs_nothing_beside_it(page):
    assert page.count("data:image/svg+xml;base64,") == 4
    assert "http" not in page
    assert "laps/default/aliased 30 %" in page
