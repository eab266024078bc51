"""A figure with its name, unit and meaning: one list gives the table for people and the JSON for programs."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure.

    Attributes:
        name: `<measure>/<backend or stage>`, e.g. `ate_rmse/gtsam-gnc`.
        value: NaN where it could not be computed.
        unit: `m`, `deg`, `s`, `1`, ...
        description: one line for people.
        bar: the limit that it is held against, if any.
        passed: whether it keeps to the bar.
    """

    name: str
    value: float
    unit: str
    description: str
    bar: float | None = None
    passed: bool | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain values; a value that is not finite becomes null, as JSON has no NaN."""
        row: dict[str, Any] = {
            "name": self.name,
            "value": self.value if math.isfinite(self.value) else None,
            "unit": self.unit,
            "description": self.description,
        }
        if self.bar is not None:
            row |= {"bar": self.bar, "passed": self.passed}
        return row


def to_json(head: dict[str, Any], metrics: Iterable[Metric]) -> str:
    """One JSON object: the head's keys, then the flat list `metrics`."""
    return json.dumps({**head, "metrics": [metric.to_json() for metric in metrics]}, indent=2)


class StageClock:
    """Process time by stage; kept apart from results, which never depend on it.

    Attributes:
        cpu_s: seconds by stage. A stage within another counts by itself alone, so that the sum is that of all stages.
    """

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}
        self._within: list[float] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the process time of the block to a stage, but for that of the stages within it."""
        self._within.append(0.0)
        start = time.process_time()
        try:
            yield
        finally:
            spent = time.process_time() - start
            self.cpu_s[name] = self.cpu_s.get(name, 0.0) + spent - self._within.pop()
            if self._within:
                self._within[-1] += spent
