"""Helpers for values whose type allows more than the case that a test has made."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def known(value: T | None) -> T:
    """The value, which the test knows to be there."""
    assert value is not None
    return value


def as_a(kind: type[T], value: object) -> T:
    """The value, which the test knows to be of this kind."""
    assert isinstance(value, kind)
    return value
