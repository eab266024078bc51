"""How well the views of a session tell its places apart: from the profiles that it stored, or made again from its keyframes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.config.gone import without_gone
from hybridmap.config.vision import MatchingConfig, ProfileConfig
from hybridmap.errors import EvaluationError
from hybridmap.evaluate.candidates import (
    DEFAULT_LIMITS,
    FROM_ANY_SIDE,
    CandidateErrors,
    Reading,
    all_readings,
    candidate_errors,
    judge_pairs,
    score_matrix,
)
from hybridmap.metrics import Metric, figure
from hybridmap.store import MapStore, SessionFolder
from hybridmap.trajectory import Trajectory, read_tum
from hybridmap.vision.profile import Profile, sees_all_around
from hybridmap.vision.templates import Mode

Progress = Callable[[int, int | None], None]


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """What of a session its profiles and their comparison depend on; `circular`: its laser sees all around."""

    profile: ProfileConfig
    matching: MatchingConfig
    mode: Mode
    max_width_px: int
    circular: bool


def evaluate_loops(folder: Path, reference: Path | None = None) -> list[Metric]:
    """Judge the candidates of a session's own mode of matching.

    Args:
        folder: the session folder.
        reference: true trajectory in the TUM format; without it the session's own.

    Returns:
        `pair_auc/<mode>`, `candidate_top1/<mode>`, `candidate_ap/<mode>`, `candidate_recall_full_precision/<mode>`.

    Raises:
        StoreError: no session there.
        StreamError: the reference is damaged.
        EvaluationError: no truth, or no profiles.
    """
    truth = truth_of(folder, reference)
    with MapStore.open(folder) as store:
        settings = view_settings(store)
        profiles, stamps = stored_profiles(store), node_stamps(store)
    if not profiles:
        raise EvaluationError(f"{folder}: its nodes hold no views: there are no candidates to judge")
    if len(profiles[0]) == 1:
        settings = replace(settings, mode="plain")
    mode, matching, circular = settings.mode, settings.matching, settings.circular and len(profiles[0]) == 1
    reading = Reading(
        mode,
        matching.mu_r,
        matching.mu_d,
        min(settings.profile.max_shift, profiles[0].shape[1] - 1),
        matching.g_bar,
        matching.sequence,
        circular,
    )
    pairs = judge_pairs(stamps, truth, FROM_ANY_SIDE if circular else DEFAULT_LIMITS)
    errors = candidate_errors(score_matrix(profiles, pairs.queries, [reading])[0], pairs)
    return candidate_metrics(mode, errors)


def every_mode(
    folder: Path, reference: Path | None = None, progress: Progress | None = None
) -> Iterator[tuple[str, CandidateErrors]]:
    """Judge every mode on the frames of a session, with its own sizes of profiles and shifts; of a laser: as fan and circle.

    Yields:
        Name of the mode, and its figures.

    Raises:
        StoreError: no session there.
        EvaluationError: no truth, or neither frames nor scans.
    """
    truth = truth_of(folder, reference)
    named = list(all_readings())
    with MapStore.open(folder) as store:
        settings, stamps = view_settings(store), node_stamps(store)
        stored = stored_profiles(store)
        if not stored or len(stored[0]) == 1:
            yield from _modes_of_ranges(store, settings, stamps, truth)
            return
        pairs = judge_pairs(stamps, truth)
        for bands in (1, 4):
            profiles = profiles_again(store, settings, bands, len(stamps), progress)
            readings = [(name, reading) for name, of, reading in named if of == bands]
            rows = score_matrix(profiles, pairs.queries, [reading for _, reading in readings])
            for (name, _), row in zip(readings, rows, strict=True):
                yield name, candidate_errors(row, pairs)


def _modes_of_ranges(
    store: MapStore, settings: ViewSettings, stamps: np.ndarray[Any, np.dtype[np.int64]], truth: Trajectory
) -> Iterator[tuple[str, CandidateErrors]]:
    profiles = stored_profiles(store)
    if not profiles:
        raise EvaluationError(f"{store.path}: its nodes hold no views: there are no candidates to judge")
    for circular in (False, True) if settings.circular else (False,):
        pairs = judge_pairs(stamps, truth, FROM_ANY_SIDE if circular else DEFAULT_LIMITS)
        readings = [Reading("plain", max_shift=settings.profile.max_shift, sequence=n, circular=circular) for n in (1, 5)]
        for reading, row in zip(readings, score_matrix(profiles, pairs.queries, readings), strict=True):
            name = "full circle, from any side" if circular else "fan, from the same side"
            yield name + (f", {reading.sequence} in a row" if reading.sequence > 1 else ""), candidate_errors(row, pairs)


def candidate_metrics(mode: str, errors: CandidateErrors) -> list[Metric]:
    """The figures of one mode."""
    views = f"of {errors.revisits} revisits among {errors.queries} views"
    rows = [
        ("pair_auc", errors.pair_auc),
        ("candidate_top1", errors.top1),
        ("candidate_ap", errors.average_precision),
        ("candidate_recall_full_precision", errors.recall_full_precision),
    ]
    return [figure(f"{measure}/{mode}", value, pairs=errors.pairs, views=views) for measure, value in rows]


def truth_of(folder: Path, reference: Path | None) -> Trajectory:
    """The reference given, or the session's own.

    Raises:
        EvaluationError: there is neither.
    """
    session = SessionFolder(folder)
    session.require()
    if reference is None and not session.groundtruth.is_file():
        raise EvaluationError(f"{folder}: no truth to judge candidates by; give --reference GT.tum")
    return read_tum(reference or session.groundtruth)


def view_settings(store: MapStore) -> ViewSettings:
    """The settings that a session's profiles were made with; what an older session did not know has its default."""
    tree: dict[str, Any] = without_gone(store.config_tree).get("vision") or {}
    rgbd = tree.get("rgbd") or {}
    return ViewSettings(
        ProfileConfig.model_validate(tree.get("profile") or {}),
        MatchingConfig.model_validate(tree.get("matching") or {}),
        rgbd.get("matching", "four-band"),
        int(rgbd.get("max_width_px", 320)),
        sees_all_around(store.rig),
    )


def node_stamps(store: MapStore) -> np.ndarray[Any, np.dtype[np.int64]]:
    """(N,) stamps of the nodes, ns."""
    return np.array([node.stamp_ns for node in store.map().nodes], dtype=np.int64)


def stored_profiles(store: MapStore) -> list[Profile]:
    """The profiles that a session stored, one a node; empty if it stored none."""
    profiles = [store.keyframe(node).get("profile") for node in range(len(store.map()))]
    return [profile for profile in profiles if profile is not None]


def profiles_again(
    store: MapStore, settings: ViewSettings, bands: int, count: int, progress: Progress | None = None
) -> list[Profile]:
    """Profiles with another number of row bands, from the stored frames.

    Raises:
        EvaluationError: a node holds no frame.
    """
    from hybridmap.vision.rgbd.keyframe import image_profile_again

    rig = store.rig
    out = []
    for node in range(count):
        profile = image_profile_again(store.keyframe(node), rig, settings.max_width_px, settings.profile, bands)
        if profile is None:
            raise EvaluationError(f"{store.path}: node {node} holds no colour with depth; expected an RGB-D session")
        out.append(profile)
        if progress is not None:
            progress(node + 1, count)
    return out
