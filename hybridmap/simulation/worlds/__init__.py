"""The worlds by name; each is built on demand."""

from __future__ import annotations

from importlib import import_module

from hybridmap.errors import ConfigError
from hybridmap.simulation.surfaces import World

_BUILDERS: dict[str, tuple[str, str]] = {
    "lab": ("lab", "lab"),
    "office": ("office", "office"),
    "corridor": ("corridor", "corridor"),
    "corridor-landmarks": ("corridor", "corridor_landmarks"),
    "campus": ("campus", "campus"),
}
_BY_CHANCE = frozenset({"campus"})


def world_names() -> tuple[str, ...]:
    """Names of the worlds that can be simulated."""
    return tuple(_BUILDERS)


def build_world(name: str, seed: int = 0) -> World:
    """Build a world.

    Args:
        name: one of `world_names()`.
        seed: of the layout of a world that is drawn by chance (`campus`); the others are always the same.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in _BUILDERS:
        raise ConfigError(f"simulation.world: no world called {name!r}; there are {', '.join(_BUILDERS)}")
    module, function = _BUILDERS[name]
    build = getattr(import_module(f"{__name__}.{module}"), function)
    world: World = build(seed) if name in _BY_CHANCE else build()
    return world
