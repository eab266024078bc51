"""Helpers that narrow the type of a value for the type checker."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def known(value: T | None) -> T:
    """Return the value. The test fails if it is None."""
    assert value is not None
    return value


def as_a(kind: type[T], value: object) -> T:
    """Return the value. The test fails if it is of another type."""
    assert isinstance(value, kind)
    return value
