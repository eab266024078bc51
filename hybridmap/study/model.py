"""A study as one configuration: sources x settings x back-ends x false loops x seeds, and the bars of its figures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from hybridmap.backends.base import ODOMETRY
from hybridmap.config.backends import BackendsConfig
from hybridmap.config.section import Section, read_mapping, said
from hybridmap.errors import ConfigError
from hybridmap.errors import quoted as quoted_value

MOST_SEEDS = 10_000
"""More runs of each cell than this would take years."""


def _counted(seeds: Any) -> Any:
    """`seeds: 3` means 0, 1, 2."""
    if not isinstance(seeds, int) or isinstance(seeds, bool):
        return seeds
    if not 1 <= seeds <= MOST_SEEDS:
        raise ValueError(f"expected how many there are, 1 to {MOST_SEEDS}, or a list of them, found {quoted_value(seeds)}")
    return tuple(range(seeds))


Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1), BeforeValidator(_counted)]
KINDS = ("simulated", "recording", "session", "graph", "synthetic")
"""What a source can be; `study.sources` has what each of them does."""
DRIVES = ("simulated", "recording")
"""Kinds of sources that are mapped."""
Rate = Annotated[float, Field(ge=0, lt=1)]
Start = Literal["own", "graph", "odometry", "chain", "angular", "reference", "replay"]
Way = Literal["solve", "replay", "drive", "mapped"]


def _listed(value: Any) -> Any:
    """A single value means a list of one."""
    return value if isinstance(value, list | tuple) else (value,)


Names = Annotated[tuple[str, ...], BeforeValidator(_listed)]


class SyntheticConfig(Section):
    """A pose graph without sensors: a robot drives in circles, and a loop joins each node to the node one lap earlier."""

    nodes: int = Field(default=120, ge=4, le=100_000)
    """Nodes of the drive."""
    per_lap: int = Field(default=40, ge=3, le=100_000)
    """Nodes per lap; the graph has `nodes - per_lap` loops."""
    step_m: float = Field(default=0.5, gt=0, le=1000)
    """Distance from node to node, m."""
    translation_m: float = Field(default=0.03, ge=1e-6, le=1000)
    """Standard deviation of every measured displacement, along and across, m."""
    rotation_rad: float = Field(default=0.01, ge=1e-6, le=10)
    """Standard deviation of every measured turn, rad."""


class SourceConfig(Section):
    """The source of a graph: exactly one of `simulated`, `recording`, `session`, `graph` and `synthetic`."""

    name: str | None = None
    """Title in the tables; default: the name of the world, folder or file."""
    simulated: str | None = None
    """A simulated world, mapped once per setting and seed; its ground truth is known."""
    recording: Path | None = None
    """A recording, mapped once per setting, and once per seed if a disturbance is random."""
    config: str | None = None
    """For drives: configuration of the mapping, by name or path; default: the world's own, or `laser` for a recording."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """For drives: settings that override the configuration, as sections or dotted keys."""
    start_s: float | None = None
    """For drives: skip this many seconds at the beginning."""
    end_s: float | None = None
    """For drives: end this many seconds after the first stamp."""
    reference: Path | None = None
    """For recordings: ground truth in the TUM format; default: that of the recording, if any."""
    relations: Path | None = None
    """For recordings: verified relative poses, lines `t1 t2 dx dy dyaw`."""
    session: Path | None = None
    """A session folder; its reference is the ground truth, if it has one."""
    graph: Path | None = None
    """A planar g2o or TORO file."""
    synthetic: SyntheticConfig | None = None
    """A graph generated from the seed."""
    first_nodes: int | None = Field(default=None, ge=3)
    """Keep only this many nodes of the graph, from its start."""
    seeds: Seeds | None = None
    """Seeds of this source; default: those of the study."""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, given: Any) -> Any:
        if isinstance(given, Mapping) and "world" in given:
            raise ValueError("`world` is now called `simulated`")
        return given

    @property
    def knows_truth(self) -> bool:
        """Whether the source always has ground truth."""
        return self.kind in ("simulated", "synthetic")

    @property
    def kind(self) -> str:
        """Kind of the source, one of `KINDS`."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def title(self) -> str:
        """Title of the source in the tables."""
        if self.name is not None:
            return self.name
        path = self.recording or self.session or self.graph
        return path.name if path is not None else self.simulated or "synthetic"


class DriftConfig(Section):
    """Errors added to the odometry edges of a frozen graph; the other edges stay."""

    heading_bias_deg_per_m: float = Field(default=0.0, ge=-360, le=360)
    """Heading bias to the left, degrees per metre of each odometry edge."""
    scale_bias: float = Field(default=0.0, gt=-1, le=100)
    """Relative error of each odometry edge's length: 0.1 makes it 10 % longer."""
    noise: float = Field(default=0.0, ge=0, le=1000)
    """Additional white noise, random by the seed, in standard deviations of the edge's information."""
    dropouts: float = Field(default=0.0, ge=0, le=1)
    """Share of the odometry edges, random by the seed, that turn by 20 deg more and slip by 0.5 m."""

    @property
    def by_chance(self) -> bool:
        """Whether the errors depend on the seed."""
        return self.noise > 0.0 or self.dropouts > 0.0

    @property
    def idle(self) -> bool:
        """Whether no errors are added."""
        return self == DriftConfig()


class SettingConfig(Section):
    """What happens to a source before the back-ends: configuration of the mapping, and disturbances."""

    name: str
    """Title in the tables."""
    config: str | None = None
    """For drives: configuration of the mapping in place of the source's."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """For drives: settings that override the configuration of the mapping, as sections or dotted keys."""
    vary: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(default_factory=dict)
    """Dotted key -> values: the entry stands for one setting per combination, named by its values."""
    disturb: dict[str, float | tuple[float, ...]] = Field(default_factory=dict)
    """For drives: disturbance (of `study.disturb.TABLE`) -> its strength; 0 changes nothing."""
    drift: DriftConfig = DriftConfig()
    """For every source: errors added to the frozen graph's odometry edges."""
    sources: Names = ()
    """Titles of the sources that it is for; default: all, as for the first setting, with which the others are compared."""

    @property
    def title(self) -> str:
        """Title of the setting in the tables."""
        return self.name


class BackendVariant(Section):
    """A back-end with its settings, the poses that it starts from, and the way it gets the graph."""

    name: str | None = None
    """Title in the tables; default: the back-end's name."""
    backend: str
    """Name of the back-end."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Its settings (the section `backends` of a configuration, without `names`), as sections or dotted keys."""
    vary: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(default_factory=dict)
    """Dotted key -> values: the entry stands for one variant per combination, named by its values."""
    start: Start | None = None
    """Initial poses, and no others: the graph's own, dead reckoning, the chain of the most certain consecutive edges, rotation
    averaging, the reference, or the back-end's own map of the graph as it grew node by node (`replay`). `own`: the graph's,
    from which the back-end may look for better ones. Default: each of the study's `starts`, without these `own`.
    """
    way: Way = "solve"
    """The whole graph at once, node by node as while driving, or node by node with the final solution at the end of the drive.
    `mapped`: nothing is solved again; the figures are those of the drive itself, by this back-end of its configuration
    (`primary`: the first one, `odometry`: dead reckoning).
    """

    @property
    def title(self) -> str:
        """Title of the variant in the tables."""
        return self.name if self.name is not None else self.backend

    @property
    def begins(self) -> str:
        """Where it begins, for the tables: its start, or `driven` where it gets the graph as it grew."""
        if self.backend == ODOMETRY and self.way != "mapped":
            return ODOMETRY
        return self.start or "own" if self.way == "solve" else "driven"


class FalseLoopsConfig(Section):
    """False loop closures added to each graph."""

    rates: Annotated[tuple[Rate, ...], Field(min_length=1)] = (0.0,)
    """Share of false loops among all loops, once they are added."""
    kinds: Annotated[tuple[Literal["random", "aliased"], ...], Field(min_length=1)] = ("random",)
    """`random` joins two random nodes; `aliased` shifts runs of true loops together."""


class StatisticsConfig(Section):
    """Statistics over the seeds."""

    confidence: float = Field(default=0.95, gt=0.5, lt=1)
    """Level of the confidence intervals."""
    resamples: int = Field(default=2000, ge=100, le=1_000_000)
    """Resamples of the bootstrap."""


class BarConfig(Section):
    """A limit for a figure, checked in every group of cells that it applies to: give `at_most` or `at_least`."""

    figure: str
    """A column of `cells.csv` or `timings.csv`."""
    at_most: float | str | None = None
    """The largest allowed value, or the title of a back-end, or of a setting, whose figure on the same drive is the limit."""
    times: float = Field(default=1.0, gt=0)
    """Factor on the figure of the back-end or setting that `at_most` names."""
    at_least: float | None = None
    """The smallest allowed value."""
    statistic: Literal["worst", "nine in ten", "median", "mean"] = "worst"
    """Statistic compared with the limit: the worst, the worst but a tenth of them, the median or the mean over the seeds."""
    sources: Names = ()
    """Titles of the sources to which the bar applies; default: all."""
    settings: Names = ()
    """Names of the settings to which the bar applies; default: all."""
    backends: Names = ()
    """Titles of the back-ends to which the bar applies; default: all but dead reckoning."""
    kinds: Names = ()
    """Kinds of false loops to which the bar applies; default: all."""
    rates: Annotated[tuple[Rate, ...], BeforeValidator(_listed)] = ()
    """Rates of false loops to which the bar applies; default: all."""

    @property
    def side(self) -> str:
        """Which limit is given: `at least` or `at most`."""
        return "at most" if self.at_least is None else "at least"


MAPPED = (
    BackendVariant(backend="odometry", way="mapped"),
    BackendVariant(name="map", backend="primary", way="mapped"),
)
"""Back-ends of a study that names none: each drive as it was mapped, beside dead reckoning."""


class StudyConfig(Section):
    """Configuration of a whole study."""

    name: str = "study"
    """Headline of the page."""
    description: str = ""
    """The question of the study, for the page."""
    seeds: Seeds = (0,)
    """Seeds of the simulator, of added noise and of false loops: a list, or a number n for 0 to n - 1."""
    sources: Annotated[tuple[SourceConfig, ...], Field(min_length=1)]
    """Graphs and drives."""
    settings: Annotated[tuple[SettingConfig, ...], Field(min_length=1)] = (SettingConfig(name="default"),)
    """Variants of the mapping and of disturbances."""
    backends: Annotated[tuple[BackendVariant, ...], Field(min_length=1)] = MAPPED
    """Back-ends; the first one is the baseline of the paired differences. Default: each drive as it was mapped."""
    starts: tuple[Start, ...] = ()
    """Each back-end that solves whole graphs and names no start of its own stands for one variant per start."""
    false_loops: FalseLoopsConfig = FalseLoopsConfig()
    """False loops."""
    statistics: StatisticsConfig = StatisticsConfig()
    """Statistics over the seeds."""
    bars: tuple[BarConfig, ...] = ()
    """Limits for the figures."""

    @property
    def maps(self) -> bool:
        """Whether a back-end is evaluated on its map of the drive itself, rather than on the frozen graph."""
        return any(variant.way == "mapped" for variant in self.backends)

    def baseline_of(self, title: str) -> str:
        """Title of the back-end with which this one is compared: the first one, from the same start if there is that."""
        first = self.backends[0]
        asked = next(variant for variant in self.backends if variant.title == title)
        alike = first.model_copy(update={"name": None, "start": asked.start})
        return next((one.title for one in self.backends if one.model_copy(update={"name": None}) == alike), first.title)

    @classmethod
    def load(cls, source: str | Path, overrides: Mapping[str, Any] | None = None) -> StudyConfig:
        """Read a study by path, or by name if it comes with the package, and apply `overrides` (`{"seeds": 3}`, dotted keys).

        Relative paths in it start in the folder of the file.

        Raises:
            ConfigError: no such file, not YAML, an unknown key (named with its path), a value out of range, or settings that do
                not fit together.
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
    def from_tree(cls, tree: Mapping[str, Any], origin: str, folder: Path) -> StudyConfig:
        """Make a study from a nested mapping; `origin` names it in errors, and relative paths start in `folder`.

        Raises:
            ConfigError: an unknown key (named with its path), a value out of range, or settings that do not fit together.
        """
        from hybridmap.study.resolve import resolved

        try:
            study = cls.model_validate(_spelt_out(tree))
        except ValidationError as error:
            raise ConfigError(f"{origin}: {said(error, cls)}") from None
        return resolved(study, origin, folder)

    def to_yaml(self) -> str:
        """The study with all defaults and absolute paths, as YAML that `load` reads back to an equal study."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def quoted(title: str) -> str:
    """A title for use in a sentence: in quotes if it has several words."""
    return f"“{title}”" if re.search(r"[\s,;]", title) else title


def named_studies() -> dict[str, Path]:
    """Name -> file, for the studies that come with the package (in a checkout: `configs/studies/`)."""
    package = Path(str(resources.files("hybridmap")))
    folder = next((f for f in (package / "configs", package.parent / "configs") if f.is_dir()), package)
    return {path.stem: path for path in sorted((folder / "studies").glob("*.yaml"))}


def backend_settings(variant: BackendVariant) -> BackendsConfig:
    """All back-end settings for a variant: the defaults, changed by the settings of the variant.

    Raises:
        ConfigError: an unknown key or a value out of range.
    """
    tree: dict[str, Any] = {}
    for dotted, value in variant.settings.items():
        merge(tree, nested(dotted, value))
    if "names" in tree:
        raise ConfigError(f"backends: {variant.title}: settings.names: use `backend: NAME` instead")
    try:
        return BackendsConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(f"backends: {variant.title}: settings: {said(error, BackendsConfig, 'backends')}") from None


def nested(dotted: str, value: Any) -> dict[str, Any]:
    """Turn a dotted key into a nested mapping: `("a.b", 1)` -> `{"a": {"b": 1}}`."""
    for key in reversed(dotted.split(".")):
        value = {key: value}
    return dict(value)


def merge(base: dict[str, Any], top: Mapping[str, Any]) -> None:
    """Merge `top` into `base` in place; nested mappings are merged, other values replaced."""
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
    """Expand short forms: a back-end or source may be just its name."""
    out = dict(tree)
    for key, field in (("backends", "backend"), ("sources", "simulated")):
        if isinstance(out.get(key), Sequence) and not isinstance(out[key], str):
            out[key] = [{field: entry} if isinstance(entry, str) else entry for entry in out[key]]
    return out
