"""Implementations by name, to which others may add: by a call, or by an entry point of an installed package."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from hybridmap.errors import HybridMapError

T = TypeVar("T")


class Table(Generic[T]):
    """Name -> factory. Names of our own come first and cannot be taken; entry points are loaded when they are asked for."""

    def __init__(self, what: str, own: Mapping[str, T], group: str, error: type[HybridMapError]) -> None:
        """A table of some implementations.

        Args:
            what: word for one of them in errors, e.g. `back-end`.
            own: those of this package.
            group: of the entry points by which installed packages add theirs.
            error: raised for a name that there is not, or is there already.
        """
        self._what, self._group, self._error = what, group, error
        self._own = dict(own)
        self._registered: dict[str, T] = {}
        self._points: tuple[EntryPoint, ...] | None = None

    def register(self, name: str, factory: T) -> None:
        """Add an implementation for this process.

        Raises:
            HybridMapError: the name is taken.
        """
        if name in self.names():
            raise self._error(f"{self._what} {name!r}: there is one of this name already; choose another name")
        self._registered[name] = factory

    def names(self) -> tuple[str, ...]:
        """Every name, ours first."""
        return tuple(dict.fromkeys((*self._own, *self._registered, *(point.name for point in self._entry_points()))))

    def values(self) -> tuple[T, ...]:
        """What every name stands for, ours first."""
        return tuple(self[name] for name in self.names())

    def __getitem__(self, name: str) -> T:
        """The factory of a name.

        Raises:
            HybridMapError: there is none; the message lists the known names. Or its package cannot be imported.
        """
        for known in (self._own, self._registered):
            if name in known:
                return known[name]
        for point in self._entry_points():
            if point.name == name:
                return self._loaded(point)
        raise self._error(f"unknown {self._what} {name!r}; there are {', '.join(self.names())}")

    def _entry_points(self) -> tuple[EntryPoint, ...]:
        if self._points is None:
            self._points = tuple(entry_points(group=self._group))
        return self._points

    def _loaded(self, point: EntryPoint) -> T:
        try:
            factory: T = point.load()
        except (ImportError, AttributeError) as error:
            raise self._error(f"{self._what} {point.name!r}: {point.value} cannot be imported: {error}") from error
        return factory


def packages() -> dict[str, str]:
    """Name and version of each installed package that adds to a table of ours."""
    points = entry_points()
    ours = (point for group in points.groups if group.startswith("hybridmap.") for point in points.select(group=group))
    return {point.dist.name: point.dist.version for point in ours if point.dist is not None}


def loaded(path: str) -> Any:
    """What `module:name` names, imported now: heavy modules wait until they are needed."""
    return EntryPoint(path, path, "").load()
