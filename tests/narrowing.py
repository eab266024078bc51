"""A helper for values that may be absent by their type and are there in the case a test has made."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def known(value: T | None) -> T:
    """The value, which the test knows to be there."""
    assert value is not None
    return value
