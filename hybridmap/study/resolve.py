"""Check and complete a study: paths, variants, and conditions that the types of its configuration cannot express."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import TypeVar

from hybridmap.backends.base import ODOMETRY
from hybridmap.backends.registry import names, takes_start
from hybridmap.errors import ConfigError
from hybridmap.simulation import world_names
from hybridmap.study import disturb
from hybridmap.study.measures import FIGURES
from hybridmap.study.model import (
    DRIVES,
    KINDS,
    BackendVariant,
    BarConfig,
    SettingConfig,
    SourceConfig,
    StudyConfig,
    backend_settings,
    quoted,
)

_OF_DRIVES = ("config", "overrides", "start_s", "end_s")
_OF_RECORDINGS = ("reference", "relations")
_PATHS = ("recording", "session", "graph", "reference", "relations")
_MOST_CELLS = 1_000_000
_Entry = TypeVar("_Entry", BackendVariant, SettingConfig)


def resolved(study: StudyConfig, origin: str, folder: Path) -> StudyConfig:
    """Check a study, make its paths absolute, and expand each list of values to vary into one variant per value.

    Args:
        study: the study as it was written.
        origin: where the study comes from, for errors.
        folder: folder in which relative paths start.

    Raises:
        ConfigError: an unknown or repeated name, a setting without effect, an environment variable in a path that is not set,
            or too many cells. Whether the files exist is not checked.
    """
    sources = tuple(_located(source, origin, folder) for source in study.sources)
    variants = tuple(single for entry in study.backends for single in _expanded(entry, "settings", "backends", origin))
    variants = tuple(single for entry in variants for single in _begun(entry, study))
    settings = tuple(single for entry in study.settings for single in _expanded(entry, "overrides", "settings", origin))
    study = study.model_copy(update={"sources": sources, "settings": settings, "backends": variants})
    _check(study, origin)
    return study


def _located(source: SourceConfig, origin: str, folder: Path) -> SourceConfig:
    """The source with absolute paths; `$NAME` in a path is an environment variable."""
    given = [kind for kind in KINDS if getattr(source, kind) is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none"
        raise ConfigError(f"{origin}: sources: {source.title}: found {found}, expected one of {', '.join(KINDS)}")
    paths = [key for key in _PATHS if getattr(source, key) is not None]
    return source.model_copy(update={key: _absolute(getattr(source, key), origin, folder) for key in paths})


def _absolute(path: Path, origin: str, folder: Path) -> Path:
    expanded = os.path.expandvars(str(path))
    unset = re.search(r"\$\{?(\w+)", expanded)
    if unset:
        raise ConfigError(
            f"{origin}: {path}: the environment variable {unset[1]} is not set; set it to the folder it stands for"
        )
    return (folder / expanded).resolve()


def _expanded(entry: _Entry, field: str, origin_key: str, origin: str) -> list[_Entry]:
    """One entry per combination of `vary`, whose values go into `field`."""
    if clash := sorted(set(entry.vary) & set(getattr(entry, field))):
        raise ConfigError(f"{origin}: {origin_key}: {entry.title}: {clash[0]} is in both {field} and vary")
    if (count := prod(map(len, entry.vary.values()))) > _MOST_CELLS:
        raise ConfigError(
            f"{origin}: {origin_key}: {entry.title}: vary gives {count} combinations, expected {_MOST_CELLS} at most"
        )
    entries = [entry.model_copy(update={"vary": {}})]
    for key, values in entry.vary.items():
        entries = [
            one.model_copy(
                update={
                    "name": f"{one.title} {key.rpartition('.')[2]}={value}",
                    field: {**getattr(one, field), key: value},
                }
            )
            for one in entries
            for value in values
        ]
    return entries


def _begun(variant: BackendVariant, study: StudyConfig) -> list[BackendVariant]:
    """One variant per start of the study, for one that solves whole graphs from a start and names none."""
    if variant.start is not None or variant.way != "solve":
        return [variant]
    if not study.starts or variant.backend == ODOMETRY:
        return [variant.model_copy(update={"start": "own"})]
    return [variant.model_copy(update={"name": f"{variant.title}, {start}", "start": start}) for start in study.starts]


def _check(study: StudyConfig, origin: str) -> None:
    lists: dict[str, list[str]] = {
        "sources": [source.title for source in study.sources],
        "settings": [setting.name for setting in study.settings],
        "backends": [variant.title for variant in study.backends],
        "starts": list(study.starts),
        "seeds": [str(seed) for seed in study.seeds],
        "false_loops.rates": [str(rate) for rate in study.false_loops.rates],
        "false_loops.kinds": list(study.false_loops.kinds),
    }
    for key, titles in lists.items():
        twice = next((title for title, count in Counter(titles).items() if count > 1), None)
        if twice is not None:
            raise ConfigError(f"{origin}: {key}: {twice!r} is given twice; give each a name of its own")
    cells = prod(len(titles) for key, titles in lists.items() if key != "starts")
    if cells > _MOST_CELLS:
        raise ConfigError(
            f"{origin}: found {cells} cells (sources x settings x back-ends x false loops x seeds), expected at most"
            f" {_MOST_CELLS}; split the study"
        )
    for variant in study.backends:
        _check_backend(variant, f"{origin}: backends")
    for source in study.sources:
        _check_source(source, study, f"{origin}: sources")
    for setting in study.settings:
        _check_setting(setting, study, f"{origin}: settings: {setting.name}")
    if study.settings[0].sources:
        raise ConfigError(
            f"{origin}: settings: {study.settings[0].name}: is the first and must be for all sources, found `sources`"
        )
    if study.maps and any(study.false_loops.rates):
        raise ConfigError(
            f"{origin}: false_loops: they cannot be added to a drive; give back-ends that solve the graph, or none"
        )
    for bar in study.bars:
        _check_bar(bar, lists, f"{origin}: bars: {bar.figure}")


def _check_backend(variant: BackendVariant, origin: str) -> None:
    if variant.backend not in names() and (variant.backend, variant.way) != ("primary", "mapped"):
        raise ConfigError(f"{origin}: unknown back-end {variant.backend!r}; there are {', '.join(names())}")
    if variant.way == "mapped" and (variant.settings or variant.start is not None):
        raise ConfigError(f"{origin}: {variant.title}: `way: mapped` takes no settings and no start; set them for the drive")
    if variant.start not in (None, "own") and not takes_start(variant.backend):
        raise ConfigError(f"{origin}: {variant.title}: begins at several poses of its own; found {variant.start}, expected own")
    if variant.start == "replay" and variant.way != "solve":
        raise ConfigError(f"{origin}: {variant.title}: `start: replay` is solved as a whole; found `way: {variant.way}`")
    backend_settings(variant)


def _check_source(source: SourceConfig, study: StudyConfig, origin: str) -> None:
    if source.simulated is not None and source.simulated not in world_names():
        known = ", ".join(world_names())
        raise ConfigError(f"{origin}: no world called {source.simulated!r}; there are {known}")
    for keys, kinds in ((_OF_DRIVES, DRIVES), (_OF_RECORDINGS, ("recording",))):
        if source.kind not in kinds and any(getattr(source, key) for key in keys):
            what = f"{', '.join(keys)} are for {' and '.join(kinds)} only"
            raise ConfigError(f"{origin}: {source.title}: found a {source.kind}; {what}")
    if source.kind not in DRIVES and study.maps:
        raise ConfigError(f"{origin}: {source.title}: is a graph; give the back-ends that solve it")
    of_it = (setting for setting in study.settings if not setting.sources or source.title in setting.sources)
    acting = next((setting.name for setting in of_it if setting.config or setting.overrides or setting.disturb), None)
    if source.kind not in DRIVES and acting is not None:
        raise ConfigError(
            f"{origin}: {source.title}: is a graph already, and the setting {quoted(acting)} has overrides, disturbances or "
            f"a configuration of a drive; use drift, or a study of its own"
        )


def _check_setting(setting: SettingConfig, study: StudyConfig, origin: str) -> None:
    titles = [source.title for source in study.sources]
    if missing := next((title for title in setting.sources if title not in titles), None):
        raise ConfigError(f"{origin}: sources has no {missing!r}; there are {', '.join(titles)}")
    for name, strength in setting.disturb.items():
        disturb.check(name, strength, origin)
    if study.maps and not setting.drift.idle:
        raise ConfigError(f"{origin}: drift is put onto a frozen graph; for a drive as it was mapped use disturb")


def _check_bar(bar: BarConfig, lists: Mapping[str, list[str]], origin: str) -> None:
    if (bar.at_most is None) == (bar.at_least is None):
        raise ConfigError(f"{origin}: expected either at_most or at_least, found {'none' if bar.at_most is None else 'both'}")
    if bar.figure not in FIGURES:
        raise ConfigError(f"{origin}: no such figure; there are {', '.join(FIGURES)}")
    named = {"sources": bar.sources, "settings": bar.settings, "backends": bar.backends, "false_loops.kinds": bar.kinds}
    named["false_loops.rates"] = tuple(map(str, bar.rates))
    if isinstance(bar.at_most, str) and bar.at_most not in lists["settings"]:
        named["backends"] = (*bar.backends, bar.at_most)
    for key, titles in named.items():
        if missing := next((title for title in titles if title not in lists[key]), None):
            raise ConfigError(f"{origin}: {key} has no {missing!r}; there are {', '.join(lists[key])}")
