"""What a verdict is and what a reason is: kinds of reasons with their words, and a reason with its place and figure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from hybridmap.trajectory import NS_PER_S


class Verdict(StrEnum):
    """How far a map can be relied on.

    `trusted`: nothing speaks against it. `doubtful`: something does; it may be right all the same. `failed`: there is no
    map beyond dead reckoning.
    """

    TRUSTED = "trusted"
    DOUBTFUL = "doubtful"
    FAILED = "failed"

    @property
    def grade(self) -> int:
        """0 trusted, 1 doubtful, 2 failed."""
        return list(Verdict).index(self)


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of reason.

    Attributes:
        verdict: the verdict on a map for which it holds.
        unit: unit of its figure and limit.
        words: template of its words, with attributes of `Reason` in braces.
    """

    verdict: Verdict
    unit: str
    words: str


KINDS = {
    "back-end failed": Kind(Verdict.FAILED, "1", "{name}; the map is dead reckoning"),
    "no map": Kind(Verdict.FAILED, "1", "{name} gave no map: chi2 is {value:.4g} at the poses that it began with"),
    "fell back": Kind(Verdict.DOUBTFUL, "1", "{name} could not go on as it should, and its map was made another way"),
    "dead reckoning": Kind(
        Verdict.DOUBTFUL,
        "1",
        "the map is dead reckoning: no loop and no registration is in it (loops measured: {value:.0f})",
    ),
    "loops refused": Kind(
        Verdict.DOUBTFUL,
        "m",
        "{count} loops agree with each other and would move the map by {value:.2f} m, but are not in it"
        " (loops of the map against them: {against}): either they have one common error, or the motion here is wrong",
    ),
    "bent": Kind(
        Verdict.DOUBTFUL,
        "sigma",
        "the map bends the chain of motion by {apart_m:.2f} m, {value:.0f} standard deviations (at most {limit:.0f}): loops or"
        " motion are wrong here",
    ),
    "unsettled": Kind(
        Verdict.DOUBTFUL, "m", "the map lies {value:.2f} m from where its own edges want it (at most {limit:.1f} m)"
    ),
    "pulled": Kind(
        Verdict.DOUBTFUL,
        "m",
        "loops that the back-end rejects pull the map by {value:.2f} m (at most {limit:.2f} m), this node most: they are false,"
        " or the others are",
    ),
    "edges contradict": Kind(
        Verdict.DOUBTFUL,
        "1",
        "the edges of the map contradict each other, this one most: unit variance {value:.1f} (at most {limit:.0f})",
    ),
    "loops alone": Kind(
        Verdict.DOUBTFUL,
        "m",
        "loops that no other loop confirms ({count}) move the map by {value:.2f} m (at most {limit:.1f} m) to where nothing"
        " else has it; the farthest joins these two nodes",
    ),
    "loops rejected": Kind(
        Verdict.DOUBTFUL, "1", "the back-end rejected {value:.0f} loops and kept {count}: hardly any loop holds the map"
    ),
    "against odometry": Kind(
        Verdict.DOUBTFUL,
        "sigma",
        "map and odometry differ by {apart_m:.2f} m, {value:.0f} standard deviations of the odometry, and no loop tells which"
        " of them is right",
    ),
    "odometry dropped": Kind(
        Verdict.DOUBTFUL,
        "%",
        "registrations contradict {value:.0f} % of the odometry edges ({count}; at most {limit:.0f} %): the wheels slip, or"
        " the clock of the sensor is not theirs",
    ),
    "clock offset": Kind(
        Verdict.DOUBTFUL,
        "s",
        "scans or frames are stamped {value:+.2f} s off odometry of the same moment (+: later; at most {limit:.2f} s), and the"
        " map was not corrected for it",
    ),
    "nodes without weight": Kind(Verdict.DOUBTFUL, "1", "nodes joined to the rest by edges without weight alone: {value:.0f}"),
    "motion unobserved": Kind(
        Verdict.DOUBTFUL,
        "m",
        "on {value:.1f} m nothing seen held the motion and no loop spans it: the map rests on odometry",
    ),
    "motion broken": Kind(
        Verdict.DOUBTFUL,
        "1",
        "the robot seems not to have driven to {value:.0f} nodes (at most {limit:.0f}): what it sees there does not fit what it"
        " saw just before",
    ),
    "not localised": Kind(
        Verdict.DOUBTFUL,
        "1",
        "nodes that lie where the odometry has them: {value:.0f}; what was seen there does not follow what was seen before, and"
        " no loop says where the robot was",
    ),
    "not joined": Kind(
        Verdict.DOUBTFUL,
        "1",
        "not joined: the map is {value:.0f} pieces, each in its own frame; where one lies on another is not known",
    ),
    "messages lost": Kind(Verdict.DOUBTFUL, "%", "{name}: messages that cannot be read: {count} ({value:.2g} %)"),
    "views dropped": Kind(
        Verdict.DOUBTFUL, "%", "{name}: left out, as the machine was too slow: {count} ({value:.0f} %, at most {limit:.0f} %)"
    ),
}
"""Every kind of reason by its name."""

_WORDS = ("value", "limit", "count", "against", "apart_m", "name")  # attributes of a reason that its words may have


@dataclass(frozen=True, slots=True)
class Reason:
    """A reason against a map.

    Attributes:
        kind: name of the kind of reason, a key of `KINDS`.
        value, limit: the figure that decided and its limit, in the unit of the kind; NaN: no figure.
        node: the first node that it concerns; None: the whole map.
        until: the last node that it concerns; None: `node` alone.
        stamp_ns: stamp of `node`, ns; None if unknown.
        start_ns: stamp of the first node, ns; None if unknown.
        count: how many loops, edges or messages it concerns.
        against: how many loops of the map speak against it.
        apart_m: how far the map is from what it contradicts, m.
        name: name of the back-end or topic that it concerns; otherwise empty.
    """

    kind: str
    value: float = math.nan
    limit: float = math.nan
    node: int | None = None
    until: int | None = None
    stamp_ns: int | None = None
    start_ns: int | None = None
    count: int = 0
    against: int = 0
    apart_m: float = math.nan
    name: str = ""

    @property
    def verdict(self) -> Verdict:
        """The verdict on a map for which this reason holds."""
        return KINDS[self.kind].verdict

    @property
    def unit(self) -> str:
        """Unit of `value` and `limit`."""
        return KINDS[self.kind].unit

    @property
    def time_s(self) -> float | None:
        """Time of `node` since the first node, s; None if unknown."""
        return None if self.stamp_ns is None or self.start_ns is None else (self.stamp_ns - self.start_ns) / NS_PER_S

    def __str__(self) -> str:
        """The reason in words, with its nodes and their time, if it has any."""
        words = KINDS[self.kind].words.format_map({name: getattr(self, name) for name in _WORDS})
        if self.node is None:
            return words
        nodes = f"node {self.node}" if self.until in (None, self.node) else f"nodes {self.node} to {self.until}"
        return f"{nodes}{'' if self.time_s is None else f' ({self.time_s:.0f} s)'}: {words}"

    def to_json(self) -> dict[str, Any]:
        """The reason as a dictionary of JSON values; what is unknown is null."""
        return {
            "kind": self.kind,
            "verdict": str(self.verdict),
            "node": self.node,
            "until_node": self.until,
            "time_s": self.time_s,
            "stamp_s": None if self.stamp_ns is None else self.stamp_ns / NS_PER_S,
            "value": self.value if math.isfinite(self.value) else None,
            "limit": self.limit if math.isfinite(self.limit) else None,
            "unit": self.unit,
            "words": str(self),
        }


def verdict_of(reasons: Iterable[Reason]) -> Verdict:
    """The verdict on a map with these reasons against it: that of the gravest; trusted without any."""
    return max((reason.verdict for reason in reasons), key=lambda verdict: verdict.grade, default=Verdict.TRUSTED)


def said_of(reasons: Sequence[Reason]) -> dict[str, Any]:
    """The keys `verdict` and `reasons` of a JSON object about a map, with their values; the order of the reasons is kept."""
    return {"verdict": str(verdict_of(reasons)), "reasons": [reason.to_json() for reason in reasons]}
