"""The proof that developers run, in small: killed runs, killed workers and a Dask cluster give the same bytes."""

from pathlib import Path

import pytest
import study_proof as proof
import yaml

from hybridmap.study.grid import lay_out
from hybridmap.study.model import StudyConfig

ROOT = Path(__file__).resolve().parents[2]


def test_the_proof_is_about_at_least_200_cells():
    cells = lay_out(StudyConfig.from_tree(proof.study(None, 8), "proof", ROOT)).cells
    assert len({cell.key for cell in cells}) >= 200


@pytest.fixture
def small(tmp_path):
    config = tmp_path / "proof.yaml"
    config.write_text(yaml.safe_dump(proof.study(None, 2)))
    alone = tmp_path / "alone"
    return config, proof.finish(proof.start(config, alone, "--workers", "0"), alone), proof.known(alone)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["killed_twice", "two_workers", "dask"])
def test_tables_are_the_same_however_it_was_run(small, tmp_path, way):
    if way == "dask":
        pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    config, told, cells = small
    assert getattr(proof, way)(config, tmp_path / way, cells) == told
