"""Graph files: both dialects, gtsam's own reader as the oracle, and damage named by file and line."""

import numpy as np
import pytest

from hybridmap.errors import GraphError
from hybridmap.geometry import between, compose, exp
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import held, read_graph, write_g2o
from hybridmap.graph.paths import chain, require_connected
from hybridmap.graph.pose_graph import PoseGraph
from tests.narrowing import known

G2O = """# a comment
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.0 0.1 0.5
VERTEX_SE2 2 2 0 -3.1
FIX 0
EDGE_SE2 0 1 1.0 0.0 0.5  10 1 2 20 3 30
EDGE_SE2 1 2 1.5 0.0 0.25 10 0 0 20 0 30

EDGE_SE2 2 0 -1 0.5 0.125 11 0 0 21 0 31
"""
TORO = """VERTEX2 0 0 0 0
VERTEX2 1 1.0 0.1 0.5
VERTEX2 2 2 0 -3.1
EDGE2 0 1 1.0 0.0 0.5  10 1 20 30 2 3
EDGE2 1 2 1.5 0.0 0.25 10 0 20 30 0 0
EDGE2 2 0 -1 0.5 0.125 11 0 21 31 0 0
"""


def written(tmp_path, text, name="graph.g2o"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_both_dialects_give_the_same_graph(tmp_path):
    g2o = read_graph(written(tmp_path, G2O))
    toro = read_graph(written(tmp_path, TORO, "graph.graph"))
    for name in ("initial", "sources", "targets", "deltas", "information", "kinds", "edge_ids"):
        assert np.array_equal(getattr(g2o, name), getattr(toro, name)), name
    assert np.array_equal(g2o.information[0], [[10, 1, 2], [1, 20, 3], [2, 3, 30]])
    assert g2o.kinds.tolist() == [EdgeKind.ODOMETRY, EdgeKind.ODOMETRY, EdgeKind.LOOP]
    g2o.validate()


def test_gtsam_reads_the_same_poses_and_measurements(tmp_path):
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(6, 3)) * [5, 5, 1.5]
    graph = random_graph(poses, rng)
    path = tmp_path / "written.g2o"
    write_g2o(path, graph, poses)
    factors, values = gtsam.readG2o(str(path), False)
    assert factors.size() == graph.n_edges
    for node in range(6):
        theirs = values.atPose2(node)
        assert np.allclose([theirs.x(), theirs.y(), theirs.theta()], poses[node], atol=1e-12)
    for edge in range(graph.n_edges):
        factor = factors.at(edge)
        measured = factor.measured()
        assert np.allclose([measured.x(), measured.y(), measured.theta()], graph.deltas[edge], atol=1e-12)
        assert np.allclose(factor.noiseModel().covariance(), np.linalg.inv(graph.information[edge]), rtol=1e-6)


def random_graph(poses, rng):
    n = len(poses)
    pairs = [(i - 1, i) for i in range(1, n)] + [(n - 1, 0), (4, 1)]
    root = rng.normal(size=(len(pairs), 3, 3))
    return PoseGraph(
        initial=poses,
        sources=np.array([p[0] for p in pairs]),
        targets=np.array([p[1] for p in pairs]),
        deltas=np.array([compose(between(poses[s], poses[t]), exp(rng.normal(size=3) * 0.1)) for s, t in pairs]),
        information=root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3),
        kinds=np.array([EdgeKind.ODOMETRY] * (n - 1) + [EdgeKind.LOOP] * 2, dtype=np.int8),
        edge_ids=np.arange(len(pairs)),
    )


def test_what_is_written_is_read_back_to_the_bit(tmp_path):
    rng = np.random.default_rng(3)
    poses = rng.normal(size=(6, 3))
    graph = random_graph(poses, rng)
    write_g2o(tmp_path / "a.g2o", graph, poses)
    back = read_graph(tmp_path / "a.g2o")
    assert np.array_equal(back.initial, poses)
    assert np.array_equal(back.deltas, graph.deltas)
    upper = np.triu_indices(3)
    assert np.array_equal(back.information[:, *upper], graph.information[:, *upper])
    write_g2o(tmp_path / "b.g2o", back, back.initial)
    assert (tmp_path / "a.g2o").read_bytes() == (tmp_path / "b.g2o").read_bytes()


def test_a_file_without_vertices_is_chained_from_its_edges(tmp_path):
    lines = [line for line in G2O.splitlines() if not line.startswith("VERTEX")]
    graph = read_graph(written(tmp_path, "\n".join(lines)))
    assert np.allclose(graph.initial, np.array([[0, 0, 0], [1, 0, 0.5], compose([1, 0, 0.5], [1.5, 0, 0.25])]))


def test_vertices_may_have_any_numbers(tmp_path):
    text = G2O.replace(" 2 ", " 70 ").replace("VERTEX_SE2 1 ", "VERTEX_SE2 9 ").replace("0 1 1.0", "0 9 1.0")
    graph = read_graph(written(tmp_path, text.replace("SE2 1 70", "SE2 9 70")))
    assert graph.n_nodes == 3
    assert graph.sources.tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("1.0 0.0 0.5  10", "1.0 0.0 0.5"), r"graph\.g2o:6: expected 11 numbers after EDGE_SE2, found 10"),
        (("1.0 0.0 0.5  10", "1.0 x 0.5 10"), r"graph\.g2o:6: expected numbers"),
        (("1.0 0.0 0.5  10", "1.0 nan 0.5 10"), r"graph\.g2o:6: found NaN or Inf"),
        (("EDGE_SE2 0 1 1.0", "EDGE_SE2 0 one 1.0"), r"graph\.g2o:6: expected 2 whole"),
        (("FIX 0", "EDGE_SE2 0"), r"graph\.g2o:5: expected 2 whole number\(s\) after EDGE_SE2, found '0'"),
        (("FIX 0", "VERTEX_SE2"), r"graph\.g2o:5: expected 1 whole number\(s\) after VERTEX_SE2, found ''"),
        (("EDGE_SE2 2 0", "EDGE_SE2 2 7"), r"graph\.g2o:9: edge 2 -> 7 names vertex 7, which the file does not give"),
        (("VERTEX_SE2 2 2", "VERTEX_SE2 1 2"), r"graph\.g2o:4: vertex 1 is given twice"),
        (("FIX 0", "VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1"), r"graph\.g2o:5: VERTEX_SE3:QUAT is a 3-D record"),
        (("FIX 0", "hello world"), r"graph\.g2o:5: unknown record 'hello'"),
        (("FIX 0", f"FIX {2**70}"), r"graph\.g2o:5: found '1180591620717411303424', expected vertex numbers of at most"),
    ],
)
def test_damage_is_named_by_file_and_line(tmp_path, change, says):
    with pytest.raises(GraphError, match=says):
        read_graph(written(tmp_path, G2O.replace(*change)))


def test_what_is_wrong_with_a_graph_is_told_in_the_numbers_of_its_file(tmp_path):
    tens = "".join(f"VERTEX_SE2 {10 * k} {k} 0 0\n" for k in (3, 1, 2))
    edges = "EDGE_SE2 10 20 1 0 0 9 0 0 9 0 9\nEDGE_SE2 20 30 1 0 0 9 0 0 9 0 {}\n"
    graph = read_graph(written(tmp_path, tens + edges.format(-1)))
    with pytest.raises(GraphError, match=r"graph\.g2o:5: edge 20 -> 30 has an information matrix that is not positive"):
        graph.validate()
    with pytest.raises(GraphError, match=r"graph\.g2o:5: edge 20 -> 30 has"):
        graph.with_edges(np.array([1])).validate()
    with pytest.raises(GraphError, match=r"graph\.g2o: vertex 30 has a pose with"):
        read_graph(written(tmp_path, tens.replace("30 3", "30 3e99") + edges.format(9))).validate()
    with pytest.raises(GraphError, match=r"graph\.g2o: vertex 20 is not connected to vertex 10"):
        read_graph(written(tmp_path, "EDGE_SE2 10 30 1 0 0 9 0 0 9 0 9\nEDGE_SE2 20 40 1 0 0 9 0 0 9 0 9\n"))


def test_vertices_keep_the_numbers_of_their_file(tmp_path):
    nodes = "".join(f"VERTEX_SE2 {vertex} {vertex} 0 0\n" for vertex in (10, 20, 30))
    edges = "".join(f"EDGE_SE2 {a} {b} 10 0 0 9 0 0 9 0 9\n" for a, b in ((10, 20), (20, 30)))
    graph = read_graph(written(tmp_path, f"{nodes}FIX 30\n{edges}"))
    write_g2o(tmp_path / "out.g2o", graph, graph.initial)
    assert (tmp_path / "out.g2o").read_text() == f"{nodes}FIX 30\n{edges}"


def test_the_first_fixed_vertex_is_held_and_written_again(tmp_path, caplog):
    graph = read_graph(written(tmp_path, G2O.replace("FIX 0", "FIX 2\nFIX 1")))
    assert "vertex 2 is held, the others may move" in caplog.text
    moved = compose([3.0, 1.0, 0.7], graph.initial)
    back = held(graph, moved)
    assert np.array_equal(back[2], graph.initial[2])
    assert np.allclose(between(back[:-1], back[1:]), between(moved[:-1], moved[1:]))
    write_g2o(tmp_path / "out.g2o", graph, back)
    again = read_graph(tmp_path / "out.g2o")
    assert (known(again.file).held, "FIX 2\n" in (tmp_path / "out.g2o").read_text()) == (2, True)
    with pytest.raises(GraphError, match=r"graph\.g2o: FIX names vertex 8, which the file does not give"):
        read_graph(written(tmp_path, G2O.replace("FIX 0", "FIX 8")))
    unfixed = read_graph(written(tmp_path, G2O.replace("FIX 0\n", "")))
    assert held(unfixed, moved) is moved


def test_files_without_edges_and_missing_files_are_refused(tmp_path):
    with pytest.raises(GraphError, match="no such graph file"):
        read_graph(tmp_path / "nothing.g2o")
    with pytest.raises(GraphError, match="holds no vertex and no edge"):
        read_graph(written(tmp_path, "# nothing\n"))
    with pytest.raises(GraphError, match="holds 1 vertex and no edge"):
        read_graph(written(tmp_path, "VERTEX_SE2 0 0 0 0\n"))
    with pytest.raises(GraphError, match="holds 2 vertices and no edge"):
        read_graph(written(tmp_path, "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\n"))


def test_a_part_that_hangs_on_nothing_is_named(tmp_path):
    text = G2O + "VERTEX_SE2 3 0 0 0\nVERTEX_SE2 4 0 0 0\nEDGE_SE2 3 4 1 0 0 1 0 0 1 0 1\n"
    graph = read_graph(written(tmp_path, text))
    with pytest.raises(GraphError, match=r"graph\.g2o: vertex 3 is not connected to vertex 0 \(2 of 5"):
        require_connected(graph)
    with pytest.raises(GraphError, match=r"graph\.g2o: vertex 3 is not connected to vertex 0"):
        chain(graph)


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "nodes", "edges", "loops"),
    [
        ("intel.g2o", 1728, 2512, 785),
        ("manhattanOlson3500.g2o", 3500, 5598, 2099),
        ("input_M3500_g2o.g2o", 3500, 5453, 1954),
        ("FR079_P_toro.graph", 989, 1217, 229),
        ("CSAIL.g2o", 1045, 1172, 128),
        ("input_INTEL_g2o.g2o", 1228, 1483, 256),
    ],
)
def test_public_graphs_have_the_sizes_that_are_known(data_dir, file, nodes, edges, loops):
    graph = read_graph(data_dir / "posegraphs" / file)
    assert (graph.n_nodes, graph.n_edges, int(graph.is_loop.sum())) == (nodes, edges, loops)
    graph.validate()
