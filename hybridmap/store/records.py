"""Sensors, edges and reports as the JSON objects that a map file keeps of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from hybridmap.backends.base import SolveReport, SolveStatus
from hybridmap.graph.edges import Check, Edge, Lack, Method, Need, Proposer, Search
from hybridmap.streams.base import Rig
from hybridmap.streams.sensors import kinds


def rig_to_json(rig: Rig) -> dict[str, Any]:
    """The sensors of a source as nested plain values that JSON can hold."""
    return {name: _plain(asdict(sensor)) for name, sensor in rig.sensors.items()}


def rig_from_json(tree: dict[str, Any]) -> Rig:
    """Make the sensors that `rig_to_json` wrote; sensors of unknown kinds are left out."""
    types = {kind.sensor_name: kind.sensor for kind in kinds()}
    found = {name: fields for name, fields in tree.items() if fields is not None and name in types}
    return Rig(**{name: types[name](**{key: _array(value) for key, value in found[name].items()}) for name in found})


def _array(value: Any) -> Any:
    numbers = _NUMBERS.validate_python(value)
    return np.array(numbers) if isinstance(numbers, list) else value


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    return {key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value for key, value in fields.items()}


def record_to_json(edge: Edge) -> str:
    """The checks, lack, method and other reasons of an edge's status as one JSON object; empty fields are left out."""
    fields = {
        "checks": [_row(check) for check in edge.checks],
        "lack": edge.lack,
        "method": edge.method,
        "search": edge.search,
        "proposed_by": edge.proposed_by,
        "figures": {name: float(value) for name, value in edge.figures.items()},
        "shift": edge.shift,
        "carried_m": edge.kidnapped_m,
        "broken_by": [_row(check) for check in edge.broken_by],
        "contradicts_odometry": edge.contradicts_odometry,
        "note": edge.note,
    }
    return json.dumps({name: value for name, value in fields.items() if value})


def record_from_json(text: str) -> dict[str, Any]:
    """The fields of an edge that `record_to_json` wrote, by name."""
    fields: dict[str, Any] = json.loads(text)
    carried_m = fields.pop("carried_m", None)
    fields["kidnapped_m"] = None if carried_m is None else float(carried_m)
    for name in ("checks", "broken_by"):
        fields[name] = tuple(_check(*row) for row in fields.get(name, ()))
    for name, kind in _OF_EDGES.items():
        if name in fields:
            fields[name] = kind(fields[name])
    return fields


def _figures(fields: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in fields.items()}


def _check(figure: str, value: float, needs: str, limit: float, setting: str | None = None) -> Check:
    return Check(str(figure), float(value), Need(needs), float(limit), None if setting is None else str(setting))


_OF_EDGES: dict[str, Callable[[Any], Any]] = {
    "lack": Lack,
    "method": Method,
    "search": Search,
    "proposed_by": Proposer,
    "figures": _figures,
    "shift": int,
    "contradicts_odometry": bool,
    "note": str,
}
"""Field of an edge's record -> its value from that in the file."""


def _row(check: Check) -> list[Any]:
    return [check.figure, check.value, check.needs, check.limit, check.setting]


def report_to_json(report: SolveReport) -> str:
    """A solver's report as one JSON object."""
    fields = asdict(report)
    fields["status"] = str(report.status)
    for name in ("rejected_edge_ids", "inconsistent_edge_ids"):
        fields[name] = [int(number) for number in fields[name]]
    for name in ("weights", "weak_edges"):
        fields[name] = {str(number): float(weight) for number, weight in fields[name].items()}
    return json.dumps(_plain(fields))


def report_from_json(text: str) -> SolveReport:
    """The report that `report_to_json` wrote."""
    fields = json.loads(text)
    fields["status"] = SolveStatus(fields["status"])
    for name in ("rejected_edge_ids", "inconsistent_edge_ids"):
        fields[name] = tuple(fields.get(name, ()))
    for name in ("weights", "weak_edges"):
        fields[name] = {int(number): weight for number, weight in fields.get(name, {}).items()}
    fields["rejected_clusters"] = tuple(tuple(cluster) for cluster in fields.get("rejected_clusters", ()))
    return _REPORT.validate_python(fields)


_REPORT = TypeAdapter(SolveReport)
_NUMBERS = TypeAdapter(float | list[float] | list[list[float]])
