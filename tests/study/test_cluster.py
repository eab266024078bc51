"""A Dask cluster that is not there is told in one line; one that is there does the work (the whole proof: test_proof)."""

import socket

import pytest

from hybridmap.errors import StudyError

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")


@pytest.mark.parametrize("address", ["nonsense", "tcp://host", "http://127.0.0.1:80", "tcp://127.0.0.1:99999999"])
def test_what_is_no_address_is_refused(address):
    from hybridmap.study.cluster import DaskCluster

    with pytest.raises(StudyError, match="expected tcp://HOST:PORT"):
        DaskCluster(address)


def test_where_nobody_listens_is_refused_at_once():
    from hybridmap.study.cluster import DaskCluster

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(StudyError, match=r"no Dask scheduler answers: .*refused"):
        DaskCluster(f"tcp://127.0.0.1:{port}")


def test_a_cluster_in_this_process_gives_every_outcome_and_tells_mistakes():
    from hybridmap.study.cluster import DaskCluster
    from hybridmap.study.pools import Lost
    from tests.study import studies

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        pool = DaskCluster(cluster.scheduler_address)
        try:
            outcomes = dict(pool.run(studies.picky, [1, 3, 5, 7]))
            assert list(pool.run(studies.picky, [])) == []
        finally:
            pool.close()
    assert outcomes == {0: 2, 1: Lost("ValueError: not this one"), 2: 10, 3: 14}
