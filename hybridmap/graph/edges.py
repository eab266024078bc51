"""Edges: kind, status, check, and the record of the decision.

The record holds the checks in their order, and what the edge lacked beside them. Status, reason in words and `explain`
follow from it alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from math import ceil, floor, inf, isfinite, nextafter
from typing import Any, Self

from hybridmap.config.root import is_allowed
from hybridmap.geometry import RelativePose


class EdgeKind(IntEnum):
    """Where an edge comes from: wheels, registration to nodes just before, loop closure, or a person.

    The first two measure motion. Only `LOOP` is a loop closure, which a robust back-end may reject.
    """

    ODOMETRY = 0
    REGISTRATION = 1
    LOOP = 2
    MANUAL = 3


class Status(StrEnum):
    """The state of an edge; only accepted edges are in the graph.

    A pending edge waits for others that agree with it. A rejected edge never was in the graph; a retracted one was.
    """

    ACCEPTED = "accepted"
    PENDING = "pending"
    REJECTED = "rejected"
    RETRACTED = "retracted"


class Method(StrEnum):
    """What an edge was measured by."""

    ODOMETRY = "odometry"
    SCANS = "scans"
    DEPTH = "depth"
    FEATURES = "features"
    FEATURES_AND_DEPTH = "features and depth"
    PROFILE = "profile"
    SEQUENCE = "sequence"
    LOOPS = "loops"
    BY_HAND = "by hand"

    @property
    def words(self) -> str:
        """The method in words, as the reason of an accepted edge."""
        return _METHODS[self]


class Search(StrEnum):
    """Why the two nodes of an edge were compared."""

    CHAIN = "chain"
    GATE = "gate"
    WHOLE_MAP = "whole map"
    NEAR = "near"
    AGAIN = "again"

    @property
    def words(self) -> str:
        """The search in words, to be added to a reason; empty string for the usual ones."""
        return _SEARCHES[self]


class Proposer(StrEnum):
    """What proposed the two nodes of a loop first."""

    PROFILE = "profile"
    PROXIMITY = "proximity"
    GLOBAL = "global"

    @property
    def words(self) -> str:
        """The proposer in words."""
        return _PROPOSERS[self]


class Lack(StrEnum):
    """Why an edge is not in the graph, if it is not for a failed check."""

    WAITING = "waiting"
    UNSUPPORTED = "unsupported"
    CONTRADICTED = "contradicted"
    NOT_LOST = "not lost"
    NO_DEPTH = "no depth"
    OVERRULED = "overruled"
    KIDNAPPED = "kidnapped"
    REMOVED = "removed"

    @property
    def words(self) -> str:
        """The lack in words."""
        return _LACKS[self][0]

    @property
    def needed(self) -> str:
        """What would have let the edge be accepted, in words."""
        return _LACKS[self][1]


_METHODS = {
    Method.ODOMETRY: "odometry",
    Method.SCANS: "scans agree",
    Method.DEPTH: "depth agrees",
    Method.FEATURES: "features agree",
    Method.FEATURES_AND_DEPTH: "features and depth agree",
    Method.PROFILE: "profile alone, not verified",
    Method.SEQUENCE: "profiles agree along the way",
    Method.LOOPS: "where the loops put the robot",
    Method.BY_HAND: "measured by hand",
}
_SEARCHES = {
    Search.CHAIN: "",
    Search.GATE: "",
    Search.WHOLE_MAP: "found on the whole map",
    Search.NEAR: "near on the map",
    Search.AGAIN: "measured again, as a back-end gave it no weight",
}
_PROPOSERS = {
    Proposer.PROFILE: "their profiles",
    Proposer.PROXIMITY: "their nearness on the map",
    Proposer.GLOBAL: "a search of the whole map",
}
_LACKS = {
    Lack.WAITING: ("waits for other edges that agree with it", "other edges near it that agree with it"),
    Lack.UNSUPPORTED: (
        "no other edges agreed with it in time",
        "other edges near it that agree with it, before it is given up",
    ),
    Lack.CONTRADICTED: (
        "contradicts the loops that were accepted",
        "loops that agree with it and outweigh those that it contradicts",
    ),
    Lack.NOT_LOST: ("the robot was where the map had it", "a robot that is lost"),
    Lack.NO_DEPTH: ("too little depth in common view", "more surfaces in common view"),
    Lack.OVERRULED: (
        "contradicted by a registration",
        "a registration that agrees with the odometry, or edges.drop_contradicted: false",
    ),
    Lack.KIDNAPPED: ("the robot was kidnapped between the two nodes", "a robot that drove from one node to the other"),
    Lack.REMOVED: ("taken out by hand", "nobody who takes it out"),
}


class Need(StrEnum):
    """Whether a checked value must be at least or at most its limit."""

    AT_LEAST = "at least"
    AT_MOST = "at most"


@dataclass(frozen=True, slots=True)
class Check:
    """A measured value and the limit that it must keep.

    Attributes:
        figure: name of the value, with its unit.
        value: what was measured; NaN never passes.
        needs: whether the value must be at least or at most the limit.
        limit: the limit that was applied.
        setting: dotted name of the setting that gives the limit; None if no single setting does.
    """

    figure: str
    value: float
    needs: Need
    limit: float
    setting: str | None = None

    @property
    def passed(self) -> bool:
        """Whether the value keeps the limit."""
        return self.value >= self.limit if self.needs is Need.AT_LEAST else self.value <= self.limit

    @property
    def slack(self) -> float:
        """Distance of the value from the limit, divided by the limit; negative if the check failed."""
        away = self.value - self.limit if self.needs is Need.AT_LEAST else self.limit - self.value
        return away / max(abs(self.limit), 1e-12)

    def __str__(self) -> str:
        sign = ">=" if self.needs is Need.AT_LEAST else "<="
        where = "" if self.setting is None else f", {self.setting}"
        return f"{self.figure} {self.value:.4g} ({sign} {self.limit:.4g}{where})"

    @property
    def miss(self) -> str:
        """A failed check in words: name, value, and limit."""
        sign = "<" if self.needs is Need.AT_LEAST else ">"
        return f"{self.figure} {self.value:.3g} {sign} {self.limit:.3g}"

    @property
    def otherwise(self) -> str:
        """What would have had to be different for the opposite outcome of the check, in words."""
        least = self.needs is Need.AT_LEAST
        setting = self.setting if self._can_move_the_limit else None
        if self.passed:
            change = "above" if least else "below"
            return f"refused with {setting or 'a limit'} {change} {self.value:.4g} (now {self.limit:.4g})"
        wanted = f"{self.figure} {'>=' if least else '<='} {self.limit:.4g} instead of {self.value:.4g}"
        return wanted if setting is None else f"{wanted}, or {setting} {'at most' if least else 'at least'} {self.value:.4g}"

    @property
    def _can_move_the_limit(self) -> bool:
        """Whether the setting may be such that the outcome is the other one."""
        if self.setting is None or not isfinite(self.value):
            return False
        up = self.passed == (self.needs is Need.AT_LEAST)
        whole, near = (ceil(self.value), inf) if up else (floor(self.value), -inf)
        moved = (self.value, whole)
        if self.passed:  # then the limit must lie beyond the value
            moved = (nextafter(self.value, near), floor(self.value) + 1 if up else ceil(self.value) - 1)
        return any(is_allowed(self.setting, value) for value in moved)


def at_least(figure: str, value: float, limit: float, setting: str | None = None) -> Check:
    """Check that a value is at least the limit; the arguments are the attributes of `Check`."""
    return Check(figure, float(value), Need.AT_LEAST, float(limit), setting)


def at_most(figure: str, value: float, limit: float, setting: str | None = None) -> Check:
    """Check that a value is at most the limit; the arguments are the attributes of `Check`."""
    return Check(figure, float(value), Need.AT_MOST, float(limit), setting)


def passed(checks: Sequence[Check]) -> bool:
    """Whether all checks passed; true if there are none."""
    return all(check.passed for check in checks)


def verdict(checks: Sequence[Check], lack: Lack | None) -> Status:
    """Status of an edge: rejected if a check failed or it lacks anything but `WAITING`, pending if it waits, else accepted."""
    if lack not in (None, Lack.WAITING) or not passed(checks):
        return Status.REJECTED
    return Status.ACCEPTED if lack is None else Status.PENDING


@dataclass(frozen=True, slots=True)
class Edge:
    """A relative pose between two nodes, its status, and the checks that decided about it.

    A front-end proposes an edge under a key of its own; the map gives it its number. A rejected or retracted edge has a failed
    check or a lack; an accepted edge has neither.

    Attributes:
        source, target: node numbers.
        kind: odometry, registration, loop closure or by hand.
        status: accepted, pending, rejected or retracted.
        relative: pose of the target in the frame of the source; None if the edge was rejected before it was measured.
        checks: the measured values that decided, with their limits, in order.
        lack: what the edge lacked beside checks; None if nothing.
        method, search: what measured the edge, and why its nodes were compared; None if unknown.
        proposed_by: of a loop, what proposed it first, however often it was measured later; None if unknown.
        shift: columns by which the view of the target is shifted against that of the source.
        figures: further measured values, by name; nothing is decided by them.
        kidnapped_m: for the edge across a kidnapping, how far from its pose by odometry the robot was found;
            None for every other edge.
        broken_by: failed checks of whether the robot drove from the source to the target.
        contradicts_odometry: whether this is a good registration that replaces the odometry edge of the same nodes.
        note: reason of the status in words, from map files of an earlier version that have no checks; otherwise empty.
        since_node: number of the newest node when the edge got its present status (-1: the map fills it in), so that a replay
            shows an edge that was accepted late at the right moment.
        key: number that the proposing front-end gave (-1: none did); a later proposal of the same key replaces this one.
    """

    source: int
    target: int
    kind: EdgeKind
    status: Status
    relative: RelativePose | None = None
    checks: tuple[Check, ...] = field(default=(), kw_only=True)
    lack: Lack | None = field(default=None, kw_only=True)
    method: Method | None = field(default=None, kw_only=True)
    search: Search | None = field(default=None, kw_only=True)
    proposed_by: Proposer | None = field(default=None, kw_only=True)
    shift: int = field(default=0, kw_only=True)
    figures: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    kidnapped_m: float | None = field(default=None, kw_only=True)
    broken_by: tuple[Check, ...] = field(default=(), kw_only=True)
    contradicts_odometry: bool = field(default=False, kw_only=True)
    note: str = field(default="", kw_only=True)
    since_node: int = field(default=-1, kw_only=True)
    key: int = field(default=-1, kw_only=True, compare=False)

    @classmethod
    def decided(
        cls,
        source: int,
        target: int,
        kind: EdgeKind,
        relative: RelativePose | None,
        checks: Sequence[Check] = (),
        lack: Lack | None = None,
        **more: Any,
    ) -> Self:
        """Make an edge whose status follows from its checks and its lack; `more` are further attributes, by name."""
        return cls(source, target, kind, verdict(checks, lack), relative, checks=tuple(checks), lack=lack, **more)

    @property
    def spans_kidnapping(self) -> bool:
        """Whether the robot was kidnapped between the two nodes, as far as was found."""
        return self.kidnapped_m is not None or self.lack is Lack.KIDNAPPED

    def settled(self, *more: Check, lack: Lack | None = None) -> Self:
        """Copy of the edge with the checks `more` added and its lack replaced (None: it lacks nothing).

        The status follows from both. `since_node` stays.
        """
        checks = (*self.checks, *more)
        return replace(self, status=verdict(checks, lack), checks=checks, lack=lack)

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that failed."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def reason(self) -> str:
        """Reason of the edge's status, in words."""
        if self.note:
            return self.note
        words = [] if self.lack is None else [self.lack.words]
        words += [check.miss for check in self.failed]
        if self.method is not None and not words:
            words.append(self.method.words)
        if self.search is not None and self.search.words:
            words.append(self.search.words)
        if self.kidnapped_m is not None:
            words.append(f"kidnapped: {self.kidnapped_m:.1f} m from where the odometry has it")
        if self.contradicts_odometry:
            words.append("contradicts the odometry")
        if self.broken_by:
            words.append(f"the chain may be broken: {', '.join(check.miss for check in self.broken_by)}")
        return "; ".join(words) or str(self.status)

    @property
    def otherwise(self) -> str:
        """What would have changed the edge's status, in words; empty string if unknown."""
        needed = [] if self.lack is None else [self.lack.needed]
        needed += [check.otherwise for check in self.failed]
        if needed or not self.checks:
            return "; and ".join(needed)
        return min(self.checks, key=lambda check: check.slack).otherwise
