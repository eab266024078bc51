"""What is known of the drives of a joint map beside its graph: each part's `metrics.json` as it was before it was joined."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from hybridmap.conclusion import Origin
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.store import MapStore
from hybridmap.store.map_store import StoredSession

FIGURES = "metrics_json"
"""Key of the facts of a session under which `metrics.json` is kept as it was before the session was joined to others."""
_DOUBTS = ("clock offset", "views dropped", "not localised", "back-end failed")
"""Kinds of reasons against a part that the joint graph does not show."""


@dataclass(frozen=True, slots=True)
class Drives:
    """What the parts of a map say.

    Attributes:
        origin: titles, counts and remarks of all of them.
        doubts: reasons against parts that the joint graph does not show, as `metrics.json` has them.
    """

    origin: Origin
    doubts: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def of(cls, store: MapStore, alone: dict[str, Any] | None = None) -> Drives:
        """Of the sessions of a map file; `alone` is what `metrics.json` says of a single one, beside metrics."""
        heads = {session.number: json.loads(text) for session, text in _kept(store)}
        if alone is not None:
            heads[store.sessions()[0].number] = alone
        experiences, sessions = store.map(), {one.number: one for one in store.sessions()}
        said = {number: f"session {number} ({sessions[number].name}): " if len(sessions) > 1 else "" for number in heads}
        origin = Origin(
            titles={key: title for head in heads.values() for key, title in head.get("titles", {}).items()},
            stream=_sums(head.get("stream", {}) for head in heads.values()),
            lost=_lost(head.get("lost", {}) for head in heads.values()),
            remarks=[said[number] + remark for number, head in heads.items() for remark in _remarks(head)],
        )
        doubts = []
        for number, head in heads.items():
            first = sessions[number].first_node
            for reason in head.get("reasons", []):
                if reason["kind"] in _DOUBTS and not _found_since(experiences, number, reason):
                    place = {key: None if reason[key] is None else reason[key] + first for key in ("node", "until_node")}
                    doubts.append({**reason, **place, "words": said[number] + reason["words"]})
        return cls(origin, doubts)


def _kept(store: MapStore) -> Iterable[tuple[StoredSession, str]]:
    for session in store.sessions():
        text = store.one("SELECT value FROM info WHERE session = ? AND key = ?", (session.number, FIGURES))
        if text is not None:
            yield session, text


def _remarks(head: dict[str, Any]) -> list[str]:
    """The remarks on a part, and its back-ends that failed: the joint map was solved anew."""
    failed = [f"{name} failed: {why}" for name, why in head.get("failed_backends", {}).items()]
    return [*head.get("remarks", []), *failed]


def _sums(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    out: dict[str, int] = {}
    for each in counts:
        for name, count in each.items():
            out[name] = out.get(name, 0) + count
    return out


def _lost(counts: Iterable[dict[str, list[int]]]) -> dict[str, list[int]]:
    out: dict[str, list[int]] = {}
    for each in counts:
        for name, (gone, stated) in each.items():
            before = out.get(name, [0, 0])
            out[name] = [before[0] + gone, before[1] + stated]
    return out


def _found_since(experiences: ExperienceMap, session: int, reason: dict[str, Any]) -> bool:
    """Whether a robot that was not localised at the end of its drive is, by loops of the nodes since to other sessions."""
    if reason["kind"] != "not localised" or reason["node"] is None:
        return False
    own = experiences.sessions[session]
    since = range(own.start + reason["node"], own.stop)
    return any(
        edge.kind is EdgeKind.LOOP
        and edge.status is Status.ACCEPTED
        and (edge.source in since or edge.target in since)
        and (edge.source in own) != (edge.target in own)
        for edge in experiences.edges
    )
