"""Tables of implementations by name, which others extend: by a call, or by an entry point of an installed package."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from hybridmap.errors import HybridMapError

T = TypeVar("T")


class Table(Generic[T]):
    """Table of implementations by name. Our own names come first and cannot be replaced; entry points are loaded on demand."""

    def __init__(self, what: str, own: Mapping[str, T], group: str, error: type[HybridMapError]) -> None:
        """Make a table.

        Args:
            what: what an entry is called in errors, e.g. `back-end`.
            own: implementations of this package.
            group: entry point group with which installed packages add theirs.
            error: raised for an unknown name, and for a name that is taken.
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
            raise self._error(f"{self._what} {name!r}: the name is taken; choose another name")
        self._registered[name] = factory

    def require_elsewhere(self, name: str) -> None:
        """Check that a process which runs no code of this program has the name, if this one has it.

        Raises:
            HybridMapError: it was registered by a call.
        """
        if name in self._registered:
            raise self._error(
                f"{self._what} {name!r}: registered by a call in this program, which the mapping process does not run; expected"
                f" an entry point of the group {self._group} in an installed package"
            )

    def names(self) -> tuple[str, ...]:
        """All names: ours first, then registered ones and those of installed packages."""
        return tuple(dict.fromkeys((*self._own, *self._registered, *(point.name for point in self._entry_points()))))

    def values(self) -> tuple[T, ...]:
        """The implementations of all names, in the order of `names`; loads those of installed packages."""
        return tuple(self[name] for name in self.names())

    def __getitem__(self, name: str) -> T:
        """The factory of a name.

        Raises:
            HybridMapError: the name is unknown (the message lists the known ones), or its package cannot be imported.
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
        except Exception as error:
            if isinstance(error.__cause__, KeyboardInterrupt):  # what compiled libraries make of Ctrl-C while they load
                raise
            package = "" if point.dist is None else f" of the package {point.dist.name}"
            found = f"{type(error).__name__}: {error}"
            raise self._error(f"{self._what} {point.name!r}{package}: {point.value} cannot be imported: {found}") from error
        return factory


def packages() -> dict[str, str]:
    """Name -> version, for each installed package that extends one of our tables."""
    points = entry_points()
    ours = (point for group in points.groups if group.startswith("hybridmap.") for point in points.select(group=group))
    return {point.dist.name: point.dist.version for point in ours if point.dist is not None}


def loaded(path: str) -> Any:
    """Import and return the object named by `module:name`."""
    return EntryPoint(path, path, "").load()
