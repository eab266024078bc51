"""Pairs of images found while they come in are those of sorting all differences of a whole recording."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap.streams.pairing import NearestPairs, Pair, pair_nearest

MS = 1_000_000


def by_sorting_all(color_ns: list[int], depth_ns: list[int], tolerance_ns: int) -> list[tuple[int, int]]:
    """Take the nearest pair of all, then the nearest of what is left, and so on."""
    apart = sorted((abs(c - d), i, j) for i, c in enumerate(color_ns) for j, d in enumerate(depth_ns))
    pairs: list[tuple[int, int]] = []
    for difference, i, j in apart:
        if difference <= tolerance_ns and all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    return sorted(pairs)


stamps_ms = st.lists(st.integers(0, 60), max_size=14).map(sorted)


@given(stamps_ms, stamps_ms, st.sampled_from([0, 1, 3, 10, 40]))
def test_they_are_the_nearest_of_all(color_ms: list[int], depth_ms: list[int], tolerance_ms: int) -> None:
    expected = by_sorting_all(color_ms, depth_ms, tolerance_ms)
    found = pair_nearest(np.array(color_ms) * MS, np.array(depth_ms) * MS, tolerance_ms / 1000)
    assert list(zip(found.color.tolist(), found.depth.tolist(), strict=True)) == expected
    assert found.unmatched_color == len(color_ms) - len(expected)
    assert found.unmatched_depth == len(depth_ms) - len(expected)


@given(stamps_ms, stamps_ms, st.randoms(use_true_random=False))
def test_whichever_topic_is_ahead(color_ms: list[int], depth_ms: list[int], random) -> None:
    """Each topic comes in order, and either may be ahead of the other by any time."""
    expected = by_sorting_all(color_ms, depth_ms, 10)
    pairs, found = NearestPairs(0.01), []
    left = [list(enumerate(color_ms)), list(enumerate(depth_ms))]
    while any(left):
        side = random.choice([side for side in (0, 1) if left[side]])
        number, stamp_ms = left[side].pop(0)
        found += (pairs.push_depth if side else pairs.push_color)(stamp_ms * MS, number)
    found += pairs.flush()
    assert [(pair.color, pair.depth) for pair in found] == expected


def test_images_of_one_stamp_do_not_wait() -> None:
    pairs = NearestPairs(0.02)
    assert pairs.push_depth(5 * MS, 0) == []
    assert pairs.push_color(5 * MS, 0) == [Pair(0, 0, 5 * MS)]
    assert pairs.waiting == ([], [])


def test_others_wait_for_the_next_image_which_may_be_nearer() -> None:
    pairs = NearestPairs(0.02)
    assert pairs.push_color(0, 0) == []
    assert pairs.push_depth(8 * MS, 0) == []
    assert pairs.push_color(33 * MS, 1) == [Pair(0, 0, 0)]


@pytest.mark.parametrize("images", [3, 300])
def test_what_waits_does_not_grow(images: int) -> None:
    pairs = NearestPairs(0.02)
    for number in range(images):
        pairs.push_color(number * 33 * MS, number)
        if number % 3:
            pairs.push_depth(number * 33 * MS + 12 * MS, number)
    assert sum(map(len, pairs.waiting)) <= 3
