"""The words for edges, shared by all that propose, keep, solve and judge them: kind, status, edge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

from hybridmap.geometry import RelativePose


class EdgeKind(IntEnum):
    """Where an edge comes from."""

    ODOMETRY = 0
    REGISTRATION = 1
    LOOP = 2
    MANUAL = 3


class Status(StrEnum):
    """What became of an edge; only accepted ones are in the graph."""

    ACCEPTED = "accepted"
    PENDING = "pending"
    REJECTED = "rejected"
    RETRACTED = "retracted"


@dataclass(frozen=True, slots=True)
class Edge:
    """A relative pose between two nodes, in the frame of the source, with its fate.

    A front-end proposes one under a key of its own; it gets its number from the map.

    Attributes:
        source, target: node numbers.
        kind: where it comes from.
        status, reason: what became of it, and why.
        relative: the measurement; None where a candidate was refused before one was made.
        scores: the figures that the decision rested on.
        since_node: number of the newest node when the edge got its present status (-1: let the map note it), so that a
            replay brings an edge that was committed late at the same moment.
        key: number within the front-end that proposed it (-1: none did): a later proposal of the same key replaces this one.
        contradicts_odometry: a registration so good that the odometry edge beside it is wrong and is to be dropped.
    """

    source: int
    target: int
    kind: EdgeKind
    status: Status
    reason: str
    relative: RelativePose | None
    scores: Mapping[str, float] = field(default_factory=dict)
    since_node: int = -1
    key: int = field(default=-1, kw_only=True, compare=False)
    contradicts_odometry: bool = field(default=False, kw_only=True)
