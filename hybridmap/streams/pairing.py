"""Pairs of images of two topics by their stamps, found while the images come in."""

from __future__ import annotations

from bisect import insort
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.streams.base import MessageKey, Planned
from hybridmap.trajectory import NS_PER_S

Stamps = NDArray[np.int64]
_BEFORE_ALL = -(2**62)
_AFTER_ALL = 2**62


@dataclass(slots=True, order=True)
class _Image:
    """An image that waits: its stamp, its number within its topic, and its partner once it is sure."""

    stamp_ns: int
    number: int
    partner: _Image | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True)
class Pair:
    """A colour and a depth image that belong together: their numbers, and the stamp of the colour image, ns."""

    color: int
    depth: int
    stamp_ns: int


class NearestPairs:
    """Pairs colour and depth images, nearest stamps first, each used once, none further apart than a tolerance.

    A pair is sure as soon as no image that is still to come can be nearer to either of the two: each is the other's nearest
    among those left, and either topic has come as far beyond. So the pairs are those that sorting all differences of a whole
    recording gives. Images of equal stamps pair at once; others wait for the next image.

    An image costs what waits within the tolerance, usually one or two.

    Attributes:
        unmatched_color, unmatched_depth: number of images that were given up without a partner.
    """

    def __init__(self, tolerance_s: float) -> None:
        """Start without images; `tolerance_s` is the largest difference of stamps, s."""
        self._tolerance_ns = round(tolerance_s * NS_PER_S)
        self._color: list[_Image] = []
        self._depth: list[_Image] = []
        self._newest_color_ns = self._newest_depth_ns = _BEFORE_ALL
        self.unmatched_color = self.unmatched_depth = 0

    def push_color(self, stamp_ns: int, number: int) -> list[Pair]:
        """Take in a colour image; returns the pairs that are sure now, in order of their colour stamps."""
        insort(self._color, _Image(stamp_ns, number))
        self._newest_color_ns = max(self._newest_color_ns, stamp_ns)
        return self._settle()

    def push_depth(self, stamp_ns: int, number: int) -> list[Pair]:
        """Take in a depth image; returns as `push_color`."""
        insort(self._depth, _Image(stamp_ns, number))
        self._newest_depth_ns = max(self._newest_depth_ns, stamp_ns)
        return self._settle()

    def flush(self) -> list[Pair]:
        """No image is still to come: returns the pairs of those that wait."""
        self._newest_color_ns = self._newest_depth_ns = _AFTER_ALL
        return self._settle()

    @property
    def waiting(self) -> tuple[list[int], list[int]]:
        """Numbers of the colour images and of the depth images that are kept."""
        return [image.number for image in self._color], [image.number for image in self._depth]

    def _settle(self) -> list[Pair]:
        while any(self._match(color) for color in self._color if color.partner is None):
            pass
        pairs = self._take_sure()
        over = [depth for depth in self._depth if self._is_over(depth, self._color, self._newest_color_ns)]
        self.unmatched_depth += len(over)
        self._depth = [depth for depth in self._depth if depth not in over]
        return pairs

    def _match(self, color: _Image) -> bool:
        """Make a pair of an image and its nearest, if that is sure."""
        depth = self._nearest(color, self._depth)
        if depth is None or self._nearest(depth, self._color) is not color:
            return False
        apart_ns = abs(color.stamp_ns - depth.stamp_ns)
        if self._newest_depth_ns < color.stamp_ns + apart_ns or self._newest_color_ns < depth.stamp_ns + apart_ns:
            return False
        color.partner, depth.partner = depth, color
        return True

    def _nearest(self, image: _Image, others: list[_Image]) -> _Image | None:
        """The nearest free image of the other topic within the tolerance, of equally near ones the earlier."""
        near = [(abs(other.stamp_ns - image.stamp_ns), other) for other in others if other.partner is None]
        within = [one for one in near if one[0] <= self._tolerance_ns]
        return min(within)[1] if within else None

    def _is_over(self, image: _Image, others: list[_Image], newest_ns: int) -> bool:
        """Whether a free image can find no partner any more."""
        free = image.partner is None and newest_ns > image.stamp_ns + self._tolerance_ns
        return free and self._nearest(image, others) is None

    def _take_sure(self) -> list[Pair]:
        """Take out the first colour images as long as it is sure what becomes of them."""
        pairs, taken = [], 0
        for color in self._color:
            if color.partner is not None:
                pairs.append(Pair(color.number, color.partner.number, color.stamp_ns))
                self._depth.remove(color.partner)
            elif self._is_over(color, self._depth, self._newest_depth_ns):
                self.unmatched_color += 1
            else:
                break
            taken += 1
        del self._color[:taken]
        return pairs


@dataclass(frozen=True, slots=True)
class Pairs:
    """Pairs of colour and depth images.

    Attributes:
        color, depth: (P,) indices of the paired images in the lists of colour and depth images; each is used once.
        unmatched_color, unmatched_depth: number of images without a partner.
    """

    color: NDArray[np.intp]
    depth: NDArray[np.intp]
    unmatched_color: int
    unmatched_depth: int


def pair_nearest(color_ns: Stamps, depth_ns: Stamps, tolerance_s: float) -> Pairs:
    """Pair the images of a whole recording, as `NearestPairs` does.

    Args:
        color_ns: (C,) sorted stamps, ns.
        depth_ns: (D,) sorted stamps, ns.
        tolerance_s: largest difference, s.

    Returns:
        Indices into both lists, row by row of one pair, in the order of `color_ns`; and the numbers of images left over.
    """
    nearest = NearestPairs(tolerance_s)
    images = [(int(stamp), 0, number) for number, stamp in enumerate(color_ns)]
    images += [(int(stamp), 1, number) for number, stamp in enumerate(depth_ns)]
    pairs: list[Pair] = []
    for stamp_ns, side, number in sorted(images):
        pairs += (nearest.push_depth if side else nearest.push_color)(stamp_ns, number)
    pairs += nearest.flush()
    table = np.array([(pair.color, pair.depth) for pair in pairs], dtype=np.intp).reshape(-1, 2)
    return Pairs(table[:, 0], table[:, 1], nearest.unmatched_color, nearest.unmatched_depth)


class PairGatherer:
    """Gathers an observation from each pair of a colour and a depth message; see `base.Gatherer`."""

    def __init__(self, topics: Mapping[str, str], config: SensorsConfig) -> None:
        """Start without messages of the topics with the roles `color` and `depth`."""
        self._color, self._depth = topics["color"], topics["depth"]
        self._pairs = NearestPairs(config.sync_tolerance_s)

    def push(self, topic: str, number: int, stamp_ns: int) -> list[Planned]:
        """Take in a message; topics of other roles give nothing."""
        if topic == self._color:
            return self._planned(self._pairs.push_color(stamp_ns, number))
        return self._planned(self._pairs.push_depth(stamp_ns, number)) if topic == self._depth else []

    def flush(self) -> list[Planned]:
        """What the messages that wait give."""
        return self._planned(self._pairs.flush())

    @property
    def waiting(self) -> frozenset[MessageKey]:
        """The messages that may still be paired."""
        color, depth = self._pairs.waiting
        return frozenset({(self._color, number) for number in color} | {(self._depth, number) for number in depth})

    @property
    def losses(self) -> dict[str, int]:
        """Numbers of messages that no observation uses."""
        return {"unmatched color": self._pairs.unmatched_color, "unmatched depth": self._pairs.unmatched_depth}

    def _planned(self, pairs: list[Pair]) -> list[Planned]:
        return [Planned(pair.stamp_ns, ((self._color, pair.color), (self._depth, pair.depth))) for pair in pairs]
