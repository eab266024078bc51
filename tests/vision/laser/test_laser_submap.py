"""The atlas: pieces of the chain, and what lies on them."""

import numpy as np
import pytest

from hybridmap.vision.laser.cloud import EMPTY
from hybridmap.vision.laser.submap import Atlas

ALONG = np.column_stack([0.5 * np.arange(20), np.zeros(20), np.zeros(20)])


@pytest.fixture
def atlas():
    out = Atlas()
    for pose in ALONG:
        out.add(EMPTY, np.zeros(0, np.float32), pose, np.zeros((3, 3)))
    return out


def test_nodes_along_the_way(atlas):
    assert atlas.along(10, 1.0, 2.0).tolist() == [8, 9, 10, 11, 12, 13, 14]
    assert atlas.along(1, 4.0, 0.0).tolist() == [0, 1]
    assert atlas.along(18, 0.0, 4.0).tolist() == [18, 19]


def test_nothing_reaches_beyond_a_piece_until_it_is_joined_again(atlas):
    atlas.part(12)
    atlas.part(6)
    assert atlas.pieces == [range(6), range(6, 12), range(12, 20)]
    assert [atlas.piece(node) for node in (5, 6, 11, 12, 20)] == [
        range(6),
        range(6, 12),
        range(6, 12),
        range(12, 20),
        range(12, 20),
    ]
    assert atlas.along(10, 9.0, 9.0).tolist() == list(range(6, 12))
    assert atlas.around(13, 2.0).nodes.tolist() == list(range(12, 18))
    atlas.join(12)
    assert atlas.along(10, 9.0, 9.0).tolist() == list(range(6, 20))
