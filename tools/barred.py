"""Figures that a tool holds against a bar of its own."""

from __future__ import annotations

from hybridmap.metrics import Metric


def at_least(name: str, value: float, bar: float, description: str, unit: str = "1") -> Metric:
    """A figure that must not be smaller than its bar."""
    return Metric(name, float(value), unit, f"{description}; at least {bar:g}", bar, bool(value >= bar))


def at_most(name: str, value: float, bar: float, description: str, unit: str = "1") -> Metric:
    """A figure that must not be larger than its bar."""
    return Metric(name, float(value), unit, f"{description}; at most {bar:g}", bar, bool(value <= bar))
