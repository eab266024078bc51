"""Maps of several drives: joined where several views agree, apart where none does, and given back bit for bit."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3

import numpy as np
import pytest

from hybridmap.backends.pieces import pieces_of, solve_by_piece
from hybridmap.backends.registry import create
from hybridmap.cli.graphs import open_graph
from hybridmap.config import Config
from hybridmap.errors import ExportError, GraphError, OutputError, StoreError, StreamError
from hybridmap.evaluate import evaluate_session
from hybridmap.export.formats import export_session
from hybridmap.geometry import align, between, compose
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.io import graph_hash
from hybridmap.report import write_report
from hybridmap.report.session_figures import known_map_figure
from hybridmap.report.session_scene import load_scene
from hybridmap.session import run
from hybridmap.sessions import joining, localizing
from hybridmap.sessions.editing import Measured, add_edge, remove_edge, remove_session
from hybridmap.sessions.joining import config_of, map_onto, merge
from hybridmap.sessions.joint_map import JointMap
from hybridmap.sessions.localizing import localize
from hybridmap.sessions.part import Part
from hybridmap.store import MapStore
from hybridmap.streams.open import open_stream
from hybridmap.trajectory import read_tum
from hybridmap.verdict import Reason


def drive(world, folder, start_s, end_s, seed, sensors="laser"):
    """Map part of a drive; the drive through a world is the same for every seed, the errors of its sensors are not."""
    named = {"simulation.world": world, "seed": seed, "backends.names": ["gtsam-gnc"], "neural.modules": 0}
    config = Config.load(sensors, named)
    return run(open_stream(world, config, start_s=start_s, end_s=end_s), config, folder).folder.path


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    root = tmp_path_factory.mktemp("drives")
    here = drive("lab", root / "here", 0.0, 22.0, 1)
    there = drive("lab", root / "there", 10.0, 36.0, 2)
    return here, there, drive("office", root / "elsewhere", 0.0, 12.0, 3)


@pytest.fixture(scope="module")
def joined(drives, tmp_path_factory):
    return merge([drives[0], drives[1]], tmp_path_factory.mktemp("joined") / "both")


def rows(path):
    """All that a map file holds, table by table."""
    with sqlite3.connect(path / "map.db" if path.is_dir() else path) as file:
        names = [row[0] for row in file.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
        return {name: sorted(file.execute(f"SELECT * FROM {name}").fetchall()) for name in names}


def test_a_second_drive_is_found_on_the_map_of_the_first(drives, joined):
    """Begun elsewhere, half a lap on, it lies on the first within centimetres; no edge of motion leads to it."""
    assert joined.joined
    with MapStore.open(joined.folder.path) as store:
        experiences, poses = store.map(), store.solutions()["gtsam-gnc"].poses
        tracks = [store.track(number).stamps_ns for number in (0, 1)]
    here, there = experiences.sessions
    truths = [read_tum(path / "reference" / "groundtruth.tum") for path in drives[:2]]
    true = np.concatenate(
        [
            truth.at(experiences.stamps_ns[list(nodes)]) for truth, nodes in zip(truths, (here, there), strict=True)
        ]
    )  # fmt: skip
    error_m = np.hypot(*(compose(align(true, poses), poses) - true)[:, :2].T)
    assert np.sqrt(np.mean(error_m**2)) < 0.03
    assert all(len(track) > 100 for track in tracks)
    across = [e for e in experiences.edges if (e.source in here) != (e.target in here) and e.status is Status.ACCEPTED]
    assert not any(edge.kind is EdgeKind.ODOMETRY for edge in across)
    assert sum(edge.kind is EdgeKind.LOOP for edge in across) >= 4


def test_the_maps_that_are_read_stay_as_they_are(drives, tmp_path):
    before = [hashlib.sha256((path / "map.db").read_bytes()).hexdigest() for path in drives[:2]]
    merge([drives[0], drives[1]], tmp_path / "both")
    assert [hashlib.sha256((path / "map.db").read_bytes()).hexdigest() for path in drives[:2]] == before


def test_every_part_comes_back_bit_for_bit(drives, joined, tmp_path):
    """Map, figures, trajectories and truth are those of before; what is left of two sessions is the other one."""
    for number, path in enumerate(drives[:2]):
        back = remove_session(joined.folder.path, 1 - number, tmp_path / str(number)).folder.path
        assert rows(back) == rows(path)
        files = sorted(file.relative_to(path) for file in path.rglob("*") if file.is_file() and file.name != "map.db")
        assert sorted(file.relative_to(back) for file in back.rglob("*") if file.is_file() and file.name != "map.db") == files
        for file in files:
            assert (back / file).read_bytes() == (path / file).read_bytes(), file


def test_an_edge_that_is_taken_out_stays_in_the_file_and_parts_what_it_joined(joined, tmp_path):
    """With all edges between them gone the two are pieces again, each in its own frame; one by hand joins them."""
    whole = tmp_path / "whole"
    shutil.copytree(joined.folder.path, whole)
    with MapStore.open(whole) as store:
        experiences, poses = store.map(), store.solutions()["gtsam-gnc"].poses
    here, there = experiences.sessions
    across = [
        number
        for number, edge in enumerate(experiences.edges)
        if edge.status is Status.ACCEPTED and (edge.source in here) != (edge.target in here)
    ]
    for number in across:
        done = remove_edge(whole, number, whole, overwrite=True)
    assert not done.joined
    assert [reason["kind"] for reason in done.head["reasons"]] == ["not joined"]
    with MapStore.open(whole) as store:
        parted = store.map()
        assert {parted.edge(number).status for number in across} == {Status.RETRACTED}
        assert store.solutions()["gtsam-gnc"].poses[there[0]] == pytest.approx(parted.initial[there[0]])
    by_hand = Measured(here[0], there[0], between(poses[here[0]], poses[there[0]]), 0.02, 0.01)
    again = add_edge(whole, by_hand, whole, overwrite=True)
    assert again.joined
    with MapStore.open(whole) as store:
        assert store.solutions()["gtsam-gnc"].poses[there[0]] == pytest.approx(poses[there[0]], abs=0.02)


def test_what_an_edge_by_hand_changed_is_solved_again_when_its_session_is_left_alone(joined, tmp_path):
    changed = add_edge(joined.folder.path, Measured(0, 10, np.array([3.0, 3.0, 0.0]), 0.02, 0.01), tmp_path / "changed")
    alone = remove_session(changed.folder.path, 1, tmp_path / "alone")
    with MapStore.open(alone.folder.path) as store:
        experiences, poses = store.map(), store.solutions()["gtsam-gnc"].poses
        assert store.info("graph_hash") == alone.head["graph_hash"] == graph_hash(experiences)
    again = create("gtsam-gnc", Config().backends).solve(experiences.pose_graph())
    assert poses == pytest.approx(again.poses, abs=1e-3)


def test_what_a_part_lost_counts_against_the_joint_map(drives, tmp_path):
    here = shutil.copytree(drives[0], tmp_path / "here")
    figures = json.loads((here / "metrics.json").read_text())
    (here / "metrics.json").write_text(json.dumps(figures | {"lost": {"scans": [90, 100]}}))
    both = merge([here, drives[1]], tmp_path / "both")
    assert both.head["lost"] == {"scans": [90, 100]}
    assert both.head["verdict"] == "doubtful"
    assert any("scans" in json.dumps(reason) for reason in both.head["reasons"])


def test_doubts_of_a_part_stay_doubts_of_the_joint_map(drives, tmp_path):
    """What the graph does not show: a clock that is off, a robot that was lost at the end and that no loop has found since."""
    here = shutil.copytree(drives[0], tmp_path / "here")
    figures = json.loads((here / "metrics.json").read_text())
    off = Reason("clock offset", 0.4, 0.1).to_json()
    lost = Reason("not localised", 3.0, 0.0, node=0, until=2).to_json()
    more = {"reasons": [off, lost], "remarks": ["a dull lens"], "failed_backends": {"isam2": "no pivot"}}
    (here / "metrics.json").write_text(json.dumps(figures | more))
    both = merge([here, drives[1]], tmp_path / "both")
    assert both.head["verdict"] == "doubtful"
    assert [reason["kind"] for reason in both.head["reasons"]] == ["clock offset"]
    assert both.head["reasons"][0]["words"].startswith("session 0 (")
    assert [remark.split(": ", 1)[1] for remark in both.head["remarks"]] == ["a dull lens", "isam2 failed: no pivot"]
    apart = merge([drives[2], here], tmp_path / "apart").head
    assert [reason["kind"] for reason in apart["reasons"]] == ["not joined", "clock offset", "not localised"]
    with MapStore.open(drives[2]) as store:
        assert apart["reasons"][2]["node"] == len(store.map())


def test_a_joint_map_is_judged_by_the_truth_of_its_newest_drive_alone(drives, tmp_path):
    there = shutil.copytree(drives[1], tmp_path / "there", ignore=shutil.ignore_patterns("reference"))
    assert not merge([drives[0], there], tmp_path / "both").folder.groundtruth.exists()
    folder = merge([there, drives[0]], tmp_path / "turned").folder
    assert folder.groundtruth.read_bytes() == (drives[0] / "reference" / "groundtruth.tum").read_bytes()


def test_an_edit_of_one_drive_keeps_what_is_known_of_it(drives, tmp_path):
    edited = add_edge(drives[0], Measured(0, 10, np.array([3.0, 3.0, 0.0]), 0.02, 0.01), tmp_path / "edited").folder
    names = sorted(file.name for file in (drives[0] / "trajectory").iterdir())
    assert sorted(file.name for file in edited.trajectory.iterdir()) == names
    before, after = (json.loads((folder / "metrics.json").read_text()) for folder in (drives[0], edited.path))
    assert {*before} == {*after}
    assert all(after[key] == before[key] for key in ("stream", "lost", "titles", "failed_backends", "backends", "source"))
    assert {"duration", "travel", "nodes", "chi2/gtsam-gnc"} <= {metric["name"] for metric in after["metrics"]}
    assert "sessions" not in after


def test_no_map_is_written_over_one_that_is_read(drives, tmp_path):
    here, there = (shutil.copytree(path, tmp_path / path.name) for path in drives[:2])
    before = rows(here)
    config = Config.load("laser", {"simulation.world": "lab"})
    stream = open_stream("lab", config, end_s=2.0)
    for out in (here, here / "within"):
        for write in (
            lambda out=out: merge([here, there], out, overwrite=True),
            lambda out=out: merge([there, here], out, overwrite=True),
            lambda out=out: map_onto(stream, config, here, out, overwrite=True),
            lambda out=out: localize(stream, config, here, out, overwrite=True),
        ):
            with pytest.raises(OutputError, match="is in the folder of a map that is read"):
                write()
    assert rows(here) == before


def test_what_is_wrong_is_told_before_the_drive_is_mapped(drives, tmp_path, monkeypatch):
    def driven(*_args, **_named):
        raise AssertionError("the drive was mapped")

    for module in (joining, localizing):
        monkeypatch.setattr(module, "run", driven)
    broken = shutil.copytree(drives[0], tmp_path / "broken")
    with sqlite3.connect(broken / "map.db") as file:
        file.execute("DELETE FROM info WHERE key = 'graph_hash'")
    config = Config.load("laser")
    stream = open_stream("lab", config)
    with pytest.raises(StoreError, match="has no finished map"):
        map_onto(stream, config, broken, tmp_path / "both")
    with pytest.raises(StoreError, match="has no finished map"):
        localize(stream, config, broken, tmp_path / "drive")
    with pytest.raises(StoreError, match="has no finished map"):
        remove_edge(broken, 3, tmp_path / "edited")
    with pytest.raises(StoreError, match=rf"^{broken}/map.db: "):
        remove_edge(broken, 3, broken, overwrite=True)
    with pytest.raises(OutputError, match="holds a session already"):
        map_onto(stream, config, drives[0], drives[1])
    assert [path.name for path in tmp_path.iterdir()] == ["broken"]


def test_only_what_is_there_can_be_taken_out(drives, joined, tmp_path):
    with pytest.raises(StoreError, match="session 7 cannot be removed"):
        remove_session(joined.folder.path, 7, tmp_path / "out")
    with pytest.raises(StoreError, match="holds 1 session"):
        remove_session(drives[0], 0, tmp_path / "out")
    with pytest.raises(StoreError, match="edge 0: odometry"):
        remove_edge(joined.folder.path, 0, tmp_path / "out")
    with pytest.raises(StoreError, match="two different nodes"):
        add_edge(joined.folder.path, Measured(3, 3, np.zeros(3), 0.1, 0.1), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def placed(folder):
    """First stamp and length of each session -> its poses, in the frame of the session that began first."""
    with MapStore.open(folder) as store:
        experiences, poses = store.map(), store.solutions()["gtsam-gnc"].poses
    found = {(int(experiences.stamps_ns[nodes[0]]), len(nodes)): poses[list(nodes)] for nodes in experiences.sessions}
    return {key: between(found[min(found)][0], of) for key, of in found.items()}


def test_in_any_order_three_drives_make_the_same_map(drives, tmp_path):
    here, there = drives[:2]
    third = drive("lab", tmp_path / "third", 4.0, 16.0, 8)
    wanted = placed(merge([here, there, third], tmp_path / "whole").folder.path)
    assert len(wanted) == 3
    for number, (first, second, last) in enumerate(((third, there, here), (there, here, third), (here, third, there))):
        two = merge([first, second], tmp_path / f"two {number}").folder.path
        three = placed(merge([last, two], tmp_path / f"three {number}").folder.path)
        for key, poses in wanted.items():
            assert three[key] == pytest.approx(poses, abs=1e-6)


def test_the_frame_is_that_of_the_first_map(drives, tmp_path):
    with MapStore.open(merge([drives[1], drives[0]], tmp_path / "turned").folder.path) as store:
        experiences, poses = store.map(), store.solutions()["gtsam-gnc"].poses
    with MapStore.open(drives[1]) as store:
        assert int(experiences.stamps_ns[0]) == int(store.map().stamps_ns[0])
        assert poses[0] == pytest.approx(store.solutions()["gtsam-gnc"].poses[0], abs=1e-9)


def test_a_drive_that_is_given_twice_is_refused(drives, joined, tmp_path):
    for maps in ([drives[0], drives[0]], [joined.folder.path, drives[1]], [drives[1], joined.folder.path]):
        with pytest.raises(StoreError, match="is the same drive as session"):
            merge(maps, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("turned", [False, True])
def test_pieces_are_looked_for_one_by_one(drives, tmp_path, turned):
    """A drive joins the piece that saw the same walls, and leaves the other where it is, whichever map is named first."""
    apart = merge([drives[2], drives[0]], tmp_path / "apart")
    assert not apart.joined
    maps = [drives[1], apart.folder.path]
    both = merge(maps[::-1] if turned else maps, tmp_path / "both")
    pieces = {
        one["source"]: [o["piece"] for o in both.head["sessions"] if o["source"] == one["source"]]
        for one in both.head["sessions"]
    }
    assert len(set(pieces["lab"])) == 1
    assert len(pieces["lab"]) == 2
    assert pieces["office"] != pieces["lab"][:1]


def test_what_was_changed_by_hand_is_joined_as_it_is(drives, joined, tmp_path):
    """Loops between sessions are found again when maps are merged; an edge by hand would be lost."""
    with MapStore.open(joined.folder.path) as store:
        here, there = store.map().sessions
    measured = Measured(here[3], there[3], np.array([3.0, 3.0, 0.0]), 0.02, 0.01)
    changed = add_edge(joined.folder.path, measured, tmp_path / "changed").folder.path
    third = drive("lab", tmp_path / "third", 4.0, 16.0, 8)
    again = merge([third, changed], tmp_path / "again").folder.path
    assert sum(edge.kind is EdgeKind.MANUAL for edge in accepted(again)) == 1


def test_a_map_that_is_continued_keeps_its_edges(drives, joined, tmp_path):
    config = Config.load("laser", {"simulation.world": "lab", "seed": 9, "backends.names": ["gtsam-gnc"], "neural.modules": 0})
    done = map_onto(open_stream("lab", config, start_s=4.0, end_s=16.0), config, joined.folder.path, tmp_path / "onto")
    assert done.joined
    with MapStore.open(joined.folder.path) as before, MapStore.open(tmp_path / "onto") as after:
        count = len(before.map())
        old = [edge for edge in after.map().edges if max(edge.source, edge.target) < count]
        assert [(e.source, e.target, e.status) for e in old] == [(e.source, e.target, e.status) for e in before.map().edges]


def test_a_drive_that_breaks_off_while_a_map_is_continued_is_kept_and_gone_on_with(drives, tmp_path):
    def broken(*_):
        raise StreamError("the cable is loose")

    config = Config.load("laser", {"simulation.world": "lab", "seed": 9, "backends.names": ["gtsam-gnc"], "neural.modules": 0})
    stream = open_stream("lab", config, start_s=4.0, end_s=16.0)
    with pytest.raises(StreamError, match="cable"):
        map_onto(stream, config, drives[0], tmp_path / "both", progress=lambda done, _: broken() if done > 40 else None)
    assert [path.name for path in tmp_path.iterdir()] == ["both-drive"]
    with MapStore.open(tmp_path / "both-drive") as store:
        assert len(store.map()) > 3
    done = map_onto(stream, config, drives[0], tmp_path / "both", resume=True)
    assert done.joined
    assert [path.name for path in tmp_path.iterdir()] == ["both"]
    with pytest.raises(StoreError, match=r"twice-drive.* is the same drive as"):
        map_onto(stream, config, done.folder.path, tmp_path / "twice")
    assert (tmp_path / "twice-drive" / "map.db").is_file()


def test_what_is_not_found_stays_apart_and_says_so(drives, tmp_path):
    """A drive through another building: two pieces, each as it was alone, and a verdict that says it."""
    apart = merge([drives[0], drives[2]], tmp_path / "apart")
    assert not apart.joined
    assert [reason["kind"] for reason in apart.head["reasons"]] == ["not joined"]
    with MapStore.open(apart.folder.path) as store, MapStore.open(drives[2]) as alone:
        nodes = store.map().sessions[1]
        poses, own = store.solutions()["gtsam-gnc"].poses[list(nodes)], alone.solutions()["gtsam-gnc"].poses
    assert between(poses[0], poses) == pytest.approx(between(own[0], own), abs=1e-3)
    assert not any((edge.source in nodes) != (edge.target in nodes) for edge in accepted(apart.folder.path))


def test_pieces_do_not_look_joined(drives, tmp_path):
    """Not on the page, where they are drawn beside each other, and in no export or solution that puts them in one frame."""
    apart = merge([drives[0], drives[2]], tmp_path / "apart").folder
    with MapStore.open(apart.path) as store:
        scene = load_scene(apart, store)
        here, there = store.map().sessions
    assert scene.nodes[list(there), 0].max() + 5.0 < scene.nodes[list(here), 0].min()
    with pytest.raises(ExportError, match="2 pieces that are not joined"):
        export_session(apart.path, "grid", tmp_path / "grid")
    with pytest.raises(GraphError, match="2 pieces that are not joined"):
        open_graph(apart.path)
    export_session(apart.path, "tum", tmp_path / "newest.tum")


def test_an_export_of_one_way_says_that_there_are_others(joined, tmp_path, caplog):
    export_session(joined.folder.path, "tum", tmp_path / "newest.tum")
    assert "of 2 sessions the way of the newest one is written" in caplog.text


def test_the_page_says_whose_trajectories_it_shows_and_that_pieces_lie_anywhere(drives, joined, tmp_path):
    apart = merge([drives[0], drives[2]], tmp_path / "apart").folder
    for folder, said in ((joined.folder, False), (apart, True)):
        page = write_report(folder).read_text()
        assert "The map has 2 sessions" in page
        assert ("the distance between them means nothing" in page) == said


def test_a_map_of_several_sessions_is_evaluated_by_its_newest(drives, joined):
    """The stamps of two sessions may be the same, and what was true of one says nothing of the other."""
    with MapStore.open(joined.folder.path) as store, MapStore.open(drives[1]) as alone:
        newest, _, numbers = store.map().of_sessions([-1])
        own = alone.map()
    assert len(newest) == len(own)
    assert [(e.source, e.target, e.status) for e in newest.edges] == [(e.source, e.target, e.status) for e in own.edges]
    assert len(numbers) == len(own.edges)
    figures = {metric.name: metric.value for metric in evaluate_session(joined.folder.path)}
    assert figures["ate_rmse/gtsam-gnc"] < 0.03


def accepted(folder):
    with MapStore.open(folder) as store:
        return [edge for edge in store.map().edges if edge.status is Status.ACCEPTED]


def test_every_piece_has_a_frame_of_its_own(drives, tmp_path):
    apart = merge([drives[0], drives[2]], tmp_path / "apart")
    with MapStore.open(apart.folder.path) as store:
        graph, config = store.map().pose_graph(), Config.from_tree(store.config_tree, "test")
    pieces = pieces_of(graph)
    assert len(pieces) == 2
    solved = solve_by_piece(create("gtsam-gnc", config.backends).solve, graph).poses
    for nodes in pieces:
        assert solved[nodes[0]] == pytest.approx(graph.initial[nodes[0]])


def test_other_sensors_are_refused(drives, tmp_path):
    config = Config.load("laser", {"simulation.world": "lab", "simulation.laser.beams": 90, "backends.names": ["gtsam-gnc"]})
    run(open_stream("lab", config, end_s=4.0), config, tmp_path / "other")
    with pytest.raises(StoreError, match="other sensors"):
        merge([drives[0], tmp_path / "other"], tmp_path / "both")
    assert not (tmp_path / "both").exists()


def test_a_drive_is_localised_on_a_map_that_stays_as_it_is(drives, tmp_path):
    """Its trajectory is in the frame of the map; it is as right there as the map is."""
    config = Config.load("laser", {"simulation.world": "lab", "seed": 4, "backends.names": ["gtsam-gnc"], "neural.modules": 0})
    before = (drives[0] / "map.db").read_bytes()
    done = localize(open_stream("lab", config, start_s=12.0, end_s=26.0), config, drives[0], tmp_path / "drive")
    assert done.found
    assert (drives[0] / "map.db").read_bytes() == before
    here, there = (
        read_tum(drives[0] / "trajectory" / "gtsam-gnc.tum"),
        read_tum(tmp_path / "drive" / "trajectory" / "on_map.tum"),
    )
    truth = read_tum(drives[0] / "reference" / "groundtruth.tum")
    pose_world_map = align(truth.at(here.stamps_ns), here.poses)
    error_m = np.hypot(*(compose(pose_world_map, there.poses) - truth.at(there.stamps_ns))[:, :2].T)
    assert np.sqrt(np.mean(error_m**2)) < 0.03
    assert done.head["localized"]["graph_hash_before"] == done.head["localized"]["graph_hash_after"]
    assert {metric.name: metric.value for metric in done.metrics}["found_after"] < 5.0
    figures = {metric.name: metric.value for metric in evaluate_session(done.folder.path)}
    assert figures["ate_rmse/on_map"] < 0.03
    page = write_report(done.folder).read_text()
    assert "<h2>On the known map</h2>" in page
    assert "The way of the drive over the nodes of the known map" in page
    with MapStore.open(drives[0]) as store:
        known = store.solutions()["gtsam-gnc"].poses
    assert known_map_figure(known, there) in page


def test_a_place_that_some_views_agree_on_is_asked_about_at_all_nodes(drives):
    """The search of the whole map does not find the first metres by themselves: the drive would be found after 2.6 m."""
    with MapStore.open(drives[0]) as here, MapStore.open(drives[1]) as there:
        joint = JointMap(config_of(here), here.rig)
        joint.take_up(Part.of(here))
        nodes = joint.take_up(Part.of(there))
        assert found(joint.join(nodes)) < 2.3
    assert any(edge.kind is EdgeKind.LOOP and edge.source == nodes.start for edge in joint.map.edges)


def found(travel_m):
    assert travel_m is not None
    return travel_m


def test_a_drive_elsewhere_is_not_localised_and_says_so(drives, tmp_path):
    config = Config.load("laser", {"simulation.world": "office", "backends.names": ["gtsam-gnc"], "neural.modules": 0})
    done = localize(open_stream("office", config, end_s=6.0), config, drives[0], tmp_path / "drive")
    assert not done.found
    assert not (tmp_path / "drive" / "trajectory" / "on_map.tum").exists()
    assert any("not localised" in remark for remark in done.head["remarks"])
    assert "was not found.</p>" in write_report(done.folder).read_text()
    assert {metric.name: metric.value for metric in done.metrics}["known_on_map"] == 0.0


def test_a_camera_finds_its_place_too(tmp_path):
    """Begun a metre ahead with the same heading: the two are one map, and neither is where the other began."""
    here, there = drive("lab", tmp_path / "here", 0.0, 14.0, 1, "rgbd"), drive("lab", tmp_path / "there", 3.0, 16.0, 2, "rgbd")
    both = merge([here, there], tmp_path / "both")
    assert both.joined
    with MapStore.open(both.folder.path) as store:
        firsts = [nodes[0] for nodes in store.map().sessions]
        poses, stamps_ns = store.solutions()["gtsam-gnc"].poses[firsts], store.map().stamps_ns[firsts]
    true = read_tum(here / "reference" / "groundtruth.tum").at(stamps_ns)
    assert np.hypot(*(true[1] - true[0])[:2]) > 1.0
    assert between(poses[0], poses[1]) == pytest.approx(between(true[0], true[1]), abs=0.03)
