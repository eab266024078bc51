"""Make figures with a bar, for the tools."""

from __future__ import annotations

from hybridmap.metrics import Metric


def at_least(name: str, value: float, bar: float, description: str, unit: str = "1") -> Metric:
    """Make a figure that passes if it is at least its bar."""
    return Metric(name, float(value), unit, f"{description}; at least {bar:g}", bar, bool(value >= bar))


def at_most(name: str, value: float, bar: float, description: str, unit: str = "1") -> Metric:
    """Make a figure that passes if it is at most its bar."""
    return Metric(name, float(value), unit, f"{description}; at most {bar:g}", bar, bool(value <= bar))
