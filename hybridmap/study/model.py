"""What a study varies, as one configuration: sources x front-end settings x back-ends x false loops x seeds."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import BeforeValidator, Field, ValidationError

from hybridmap.config.backends import BackendsConfig
from hybridmap.config.section import Section, read_mapping, said
from hybridmap.errors import ConfigError


def _counted(seeds: Any) -> Any:
    """`seeds: 3` means 0, 1, 2."""
    if not isinstance(seeds, int) or isinstance(seeds, bool):
        return seeds
    if seeds < 1:
        raise ValueError(f"expected how many there are, 1 or more, or a list of them, found {seeds}")
    return tuple(range(seeds))


Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1), BeforeValidator(_counted)]
_OF_WORLDS = ("config", "overrides", "start_s", "end_s")
Rate = Annotated[float, Field(ge=0, lt=1)]


class SyntheticConfig(Section):
    """A pose graph without sensors: a robot drives round and round; each node sees the one a lap ago. The truth is known."""

    nodes: int = Field(default=120, ge=4)
    """Nodes of the drive."""
    per_lap: int = Field(default=40, ge=3)
    """Nodes a lap; the graph has `nodes - per_lap` loops."""
    step_m: float = Field(default=0.5, gt=0)
    """Distance from node to node, m."""
    translation_m: float = Field(default=0.03, gt=0)
    """Standard deviation of every measured displacement, along and across, m."""
    rotation_rad: float = Field(default=0.01, gt=0)
    """Standard deviation of every measured turn, rad."""


class SourceConfig(Section):
    """Where a graph comes from: exactly one of `world`, `session`, `graph` and `synthetic`."""

    name: str | None = None
    """How the tables call it; default: the world's, folder's or file's name."""
    world: str | None = None
    """A simulated world, mapped once for each front-end setting and seed."""
    config: str | None = None
    """With `world`: the mapping configuration, by name or path; default: the world's own."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """With `world`: settings on top of it, as sections or dotted keys."""
    start_s: float | None = None
    """With `world`: leave out so many seconds at the beginning."""
    end_s: float | None = None
    """With `world`: drive only so many seconds."""
    session: Path | None = None
    """A session folder; its truth is the reference if it has one."""
    graph: Path | None = None
    """A planar g2o or TORO file."""
    synthetic: SyntheticConfig | None = None
    """A graph made up from the seed."""
    first_nodes: int | None = Field(default=None, ge=3)
    """Keep only so many nodes of the graph."""

    @property
    def title(self) -> str:
        """How the tables call it."""
        if self.name is not None:
            return self.name
        path = self.session or self.graph
        return path.name if path is not None else self.world or "synthetic"


class DriftConfig(Section):
    """Errors put on top of a frozen graph's odometry edges; the other edges stay as they are."""

    heading_bias_deg_per_m: float = 0.0
    """Pull to the left, degrees per metre of each odometry edge."""
    scale_bias: float = Field(default=0.0, gt=-1)
    """Relative error of each odometry edge's length."""
    noise: float = Field(default=0.0, ge=0)
    """Further white noise by the seed, in standard deviations of what the edge's information says."""
    dropouts: float = Field(default=0.0, ge=0, le=1)
    """Share of the odometry edges, by the seed, that turn by 20 deg more and slip by 0.5 m."""

    @property
    def by_chance(self) -> bool:
        """Whether the seed plays a part."""
        return self.noise > 0.0 or self.dropouts > 0.0

    @property
    def idle(self) -> bool:
        """Whether it changes nothing."""
        return self == DriftConfig()


class SettingConfig(Section):
    """One setting of what comes before the back-ends."""

    name: str
    """How the tables call it."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """For worlds: settings on top of the mapping configuration, as sections or dotted keys."""
    drift: DriftConfig = DriftConfig()
    """For every source: errors put on the frozen graph's odometry edges."""


class BackendVariant(Section):
    """A back-end with its settings and the way in which it gets the graph."""

    name: str | None = None
    """How the tables call it; default: the back-end's name."""
    backend: str
    """Name of the back-end."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Its settings (the section `backends` of a configuration, without `names`), as sections or dotted keys."""
    vary: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(default_factory=dict)
    """Dotted key -> values: this entry stands for one variant for each combination, named by its values."""
    start: Literal["graph", "odometry", "chain", "angular", "reference"] = "graph"
    """Poses that it begins with: the graph's own, dead reckoning, the chain of the best consecutive edges, the angular
    start, or the reference itself. (`gtsam-lm` and its like also try a start of their own when they solve a whole graph.)"""
    way: Literal["solve", "replay", "drive"] = "solve"
    """The whole graph at once, node by node as while driving, or that with the final solution at the end of the drive."""

    @property
    def title(self) -> str:
        """How the tables call it."""
        return self.name if self.name is not None else self.backend


class FalseLoopsConfig(Section):
    """False loop closures put into each graph."""

    rates: Annotated[tuple[Rate, ...], Field(min_length=1)] = (0.0,)
    """Share of false loops among all loops."""
    kinds: Annotated[tuple[Literal["random", "aliased"], ...], Field(min_length=1)] = ("random",)
    """`random` joins two random nodes, `aliased` moves runs of true loops together."""


class StatisticsConfig(Section):
    """How the cells are summed up over the seeds."""

    confidence: float = Field(default=0.95, gt=0.5, lt=1)
    """Of the confidence intervals."""
    method: Literal["t", "bootstrap"] = "t"
    """Student's t, or the bias-corrected and accelerated bootstrap."""
    resamples: int = Field(default=2000, ge=100)
    """Of the bootstrap."""


class StudyConfig(Section):
    """A whole study."""

    name: str = "study"
    """Headline of the page."""
    description: str = ""
    """What is asked, for the page."""
    seeds: Seeds = (0,)
    """Seeds of the simulator, of added noise and of false loops."""
    sources: Annotated[tuple[SourceConfig, ...], Field(min_length=1)]
    """Graphs, or where they come from."""
    settings: Annotated[tuple[SettingConfig, ...], Field(min_length=1)] = (SettingConfig(name="default"),)
    """Settings of what comes before the back-ends."""
    backends: Annotated[tuple[BackendVariant, ...], Field(min_length=1)]
    """Back-ends; the first one is the baseline of the paired differences."""
    false_loops: FalseLoopsConfig = FalseLoopsConfig()
    """False loops."""
    statistics: StatisticsConfig = StatisticsConfig()
    """Summing up."""

    @classmethod
    def load(cls, source: str | Path, overrides: Mapping[str, Any] | None = None) -> Self:
        """Read a study by path, or by name if it comes with the package, with `overrides` (`{"seeds": 3}`) on top.

        Raises:
            ConfigError: no such file, not YAML, an unknown key (named with its path), a value out of range.
        """
        path = _find(source)
        tree = {"name": path.stem, **read_mapping(path)}
        changed = deepcopy(tree)
        for dotted, value in (overrides or {}).items():
            merge(changed, nested(dotted, value))
        try:
            return cls.from_tree(changed, str(path) if changed == tree else "command line", path.parent)
        except ConfigError:
            cls.from_tree(tree, str(path), path.parent)
            raise

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any], origin: str, folder: Path) -> Self:
        """Validate a nested mapping; `origin` names it in errors, relative paths begin in `folder`.

        Raises:
            ConfigError: as `load`.
        """
        try:
            study = cls.model_validate(_spelt_out(tree))
        except ValidationError as error:
            raise ConfigError(f"{origin}: {said(error)}") from None
        sources = tuple(_located(source, origin, folder) for source in study.sources)
        variants = tuple(single for entry in study.backends for single in _expanded(entry, origin))
        study = study.model_copy(update={"sources": sources, "backends": variants})
        _check(study, origin)
        return study

    def to_yaml(self) -> str:
        """The resolved study as YAML that `load` reads back to an equal one."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def quoted(title: str) -> str:
    """A title as it stands within a sentence: in quotes where it is of several words."""
    return f"“{title}”" if re.search(r"[\s,;]", title) else title


def named_studies() -> dict[str, Path]:
    """Name -> file of the studies that come with the package (in a checkout: `configs/studies/`)."""
    package = Path(str(resources.files("hybridmap")))
    folder = next((f for f in (package / "configs", package.parent / "configs") if f.is_dir()), package)
    return {path.stem: path for path in sorted((folder / "studies").glob("*.yaml"))}


def backend_settings(variant: BackendVariant) -> BackendsConfig:
    """The whole section that a variant's back-end is made with.

    Raises:
        ConfigError: an unknown key or a value out of range.
    """
    tree: dict[str, Any] = {}
    for dotted, value in variant.settings.items():
        merge(tree, nested(dotted, value))
    if "names" in tree:
        raise ConfigError(f"backends: {variant.title}: settings.names: say `backend: NAME` instead")
    try:
        return BackendsConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(f"backends: {variant.title}: settings: {said(error, 'backends')}") from None


def nested(dotted: str, value: Any) -> dict[str, Any]:
    """`("a.b", 1)` -> `{"a": {"b": 1}}`."""
    for key in reversed(dotted.split(".")):
        value = {key: value}
    return dict(value)


def merge(base: dict[str, Any], top: Mapping[str, Any]) -> None:
    """Put `top` onto `base`, section by section."""
    for key, value in top.items():
        if isinstance(value, Mapping) and isinstance(base.get(key), dict):
            merge(base[key], value)
        else:
            base[key] = dict(value) if isinstance(value, Mapping) else value


def _find(source: str | Path) -> Path:
    path = Path(source)
    if path.is_file():
        return path
    known = named_studies()
    if str(source) in known:
        return known[str(source)]
    raise ConfigError(f"{source}: no such study file; studies that come with hybridmap: {', '.join(known)}")


def _spelt_out(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Short forms made long: a back-end or source may be just its name."""
    out = dict(tree)
    for key, field in (("backends", "backend"), ("sources", "world")):
        if isinstance(out.get(key), Sequence) and not isinstance(out[key], str):
            out[key] = [{field: entry} if isinstance(entry, str) else entry for entry in out[key]]
    return out


def _located(source: SourceConfig, origin: str, folder: Path) -> SourceConfig:
    """The source with absolute paths; `$NAME` in a path is the environment's."""
    given = [key for key in ("world", "session", "graph", "synthetic") if getattr(source, key) is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none"
        raise ConfigError(f"{origin}: sources: {source.title}: found {found}, expected one of world, session, graph, synthetic")
    return source.model_copy(
        update={key: _absolute(getattr(source, key), origin, folder) for key in ("session", "graph") if key in given}
    )


def _absolute(path: Path, origin: str, folder: Path) -> Path:
    expanded = os.path.expandvars(str(path))
    unset = re.search(r"\$\{?(\w+)", expanded)
    if unset:
        raise ConfigError(
            f"{origin}: {path}: the environment variable {unset[1]} is not set; set it to the folder it stands for"
        )
    return (folder / expanded).resolve()


def _expanded(entry: BackendVariant, origin: str) -> list[BackendVariant]:
    """One variant for each combination of `vary`."""
    if clash := sorted(set(entry.vary) & set(entry.settings)):
        raise ConfigError(f"{origin}: backends: {entry.title}: {clash[0]} is in both settings and vary")
    variants = [entry.model_copy(update={"vary": {}})]
    for key, values in entry.vary.items():
        variants = [
            one.model_copy(
                update={"name": f"{one.title} {key.rpartition('.')[2]}={value}", "settings": {**one.settings, key: value}}
            )
            for one in variants
            for value in values
        ]
    return variants


def _check(study: StudyConfig, origin: str) -> None:
    """What pydantic cannot see: names given twice, back-ends and worlds that there are not, settings that cannot act."""
    from hybridmap.backends.registry import names
    from hybridmap.simulation import world_names

    lists: dict[str, list[str]] = {
        "sources": [source.title for source in study.sources],
        "settings": [setting.name for setting in study.settings],
        "backends": [variant.title for variant in study.backends],
        "seeds": [str(seed) for seed in study.seeds],
        "false_loops.rates": [str(rate) for rate in study.false_loops.rates],
        "false_loops.kinds": list(study.false_loops.kinds),
    }
    for key, titles in lists.items():
        twice = next((title for title in titles if titles.count(title) > 1), None)
        if twice is not None:
            raise ConfigError(f"{origin}: {key}: {twice!r} is there twice; give each its own name")
    for variant in study.backends:
        if variant.backend not in names():
            raise ConfigError(f"{origin}: backends: unknown back-end {variant.backend!r}; there are {', '.join(names())}")
        backend_settings(variant)
    for source in study.sources:
        if source.world is not None and source.world not in world_names():
            known = ", ".join(world_names())
            raise ConfigError(f"{origin}: sources: no world called {source.world!r}; there are {known}")
        if source.world is None and any(getattr(source, key) for key in _OF_WORLDS):
            raise ConfigError(f"{origin}: sources: {source.title}: {', '.join(_OF_WORLDS)} are for worlds only")
        overriding = next((setting.name for setting in study.settings if setting.overrides), None)
        if source.world is None and overriding is not None:
            raise ConfigError(
                f"{origin}: settings: {overriding}: overrides need a world to map, and {source.title} is a graph already; "
                f"use drift, or a study of its own"
            )
