"""How well the stored scanline profiles of a session tell its places apart.

Two nodes show *the same* place if they are within `same_m` and `same_deg` of each other, *different* ones if they are
beyond `other_m` or `other_deg`; other pairs are not used. Each node is compared only with nodes at least `gap_s` older.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.gone import without_gone
from hybridmap.config.vision import MatchingConfig, ProfileConfig
from hybridmap.errors import EvaluationError, counted
from hybridmap.geometry import Array, wrap_angle
from hybridmap.metrics import Metric, figure
from hybridmap.store import MapStore, SessionFolder
from hybridmap.trajectory import MAX_GAP_S, NS_PER_S, Trajectory, known_at, read_tum
from hybridmap.vision.profile import Profile, sees_all_around
from hybridmap.vision.templates import GBar, Mode, ProfileStore, band_weights, combine, in_sequence

Indices = NDArray[np.int64]

MOST_QUERIES = 400
"""Views that are compared with all older ones; of longer sessions so many, evenly spread."""


@dataclass(frozen=True, slots=True)
class CandidateLimits:
    """Limits by which two nodes count as the same place or as different places.

    Attributes:
        same_m, same_deg: largest distance and turn between nodes at the same place.
        other_m, other_deg: nodes farther apart than either are at different places; pairs in between are not used.
        gap_s: least time between two nodes that are compared.
    """

    same_m: float = 1.0
    same_deg: float = 30.0
    other_m: float = 2.0
    other_deg: float = 60.0
    gap_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Reading:
    """Settings by which the score G of two views is computed from their scanline profiles.

    Attributes:
        mode: formula of G, see `vision.templates.combine`.
        mu_r, mu_d: weights of the intensity and of the depth profile.
        max_shift: largest shift tried, columns.
        g_bar: definition of g_bar in G, see `vision.templates.combine`.
        sequence: number of consecutive views over which G is averaged.
        circular: whether the profiles cover 360 degrees.
    """

    mode: Mode
    mu_r: float = 0.7
    mu_d: float = 0.3
    max_shift: int = 16
    g_bar: GBar = "templates"
    sequence: int = 1
    circular: bool = False


@dataclass(frozen=True, slots=True)
class CandidateErrors:
    """How well the score G of two views tells places apart. A revisit is a view with an older view of the same place.

    Attributes:
        pair_auc: probability that a pair of the same place scores better than one of different places; 0.5 by chance.
        top1: share of the revisits whose best match among all older nodes is the same place.
        average_precision: area under the precision-recall curve of the best matches.
        recall_full_precision: largest recall of the revisits at a threshold without any false match.
        queries, revisits, pairs: number of views that were compared with older ones, of revisits, and of pairs used.
    """

    pair_auc: float
    top1: float
    average_precision: float
    recall_full_precision: float
    queries: int
    revisits: int
    pairs: int


@dataclass(frozen=True, slots=True)
class Truth:
    """Which pairs of nodes show the same place, by their true poses.

    Attributes:
        queries: (Q,) numbers of the nodes that are compared with older ones, ascending.
        same, different: (Q, N) for each of them and each of all N nodes; both False if the pair is not used.
    """

    queries: Indices
    same: NDArray[np.bool_]
    different: NDArray[np.bool_]


DEFAULT_LIMITS = CandidateLimits()
FROM_ANY_SIDE = CandidateLimits(same_deg=180.0, other_deg=180.0)
"""For views that go full circle: a place is the same from whichever side it is entered."""


def judge_pairs(
    stamps_ns: NDArray[np.int64],
    truth: Trajectory,
    limits: CandidateLimits = DEFAULT_LIMITS,
    max_gap_s: float = MAX_GAP_S,
) -> Truth:
    """Determine from the true poses which nodes show the same place.

    Args:
        stamps_ns: (N,) stamps of the nodes.
        truth: true trajectory, in any frame.
        limits: when two nodes show the same place.
        max_gap_s: longest gap of the truth over which it is interpolated, s.

    Returns:
        The pairs of every node with a known pose, or of `MOST_QUERIES` evenly spaced ones, and all nodes older by
        `limits.gap_s`.
    """
    known = known_at(truth, stamps_ns, max_gap_s)
    poses: Array = truth.at(stamps_ns) if known.any() else np.zeros((len(stamps_ns), 3))
    candidates = np.flatnonzero(known & (stamps_ns - stamps_ns[0] >= limits.gap_s * NS_PER_S))
    spread = np.linspace(0, len(candidates) - 1, min(len(candidates), MOST_QUERIES)).round().astype(np.int64)
    queries = candidates[spread]
    offset = poses[None, :] - poses[queries, None]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    turned = np.degrees(np.abs(wrap_angle(offset[..., 2])))
    judged = known[None] & (stamps_ns[queries, None] - stamps_ns[None] >= limits.gap_s * NS_PER_S)
    same = judged & (distance <= limits.same_m) & (turned <= limits.same_deg)
    different = judged & ((distance > limits.other_m) | (turned > limits.other_deg))
    return Truth(queries, same, different)


def score_matrix(profiles: Sequence[Profile], queries: Indices, reading: Reading) -> Array:
    """Scores of views against all older ones.

    Args:
        profiles: scanline profile of every node, (bands, width) each.
        queries: (Q,) numbers of the nodes whose views are compared with older ones, ascending.
        reading: how the score is computed.

    Returns:
        (Q, N) score G, infinite where a node is not older than the view. Smaller is better, except with the mode `literal`,
        see `vision.templates.combine`.
    """
    store = ProfileStore(reading.max_shift, reading.circular)
    for profile in profiles:
        store.add(profile)
    wanted = _with_predecessors(queries, reading.sequence)
    rows = np.full((len(wanted), len(profiles)), np.inf)
    for at, number in enumerate(wanted):
        if number > 0:
            g = store.differences(profiles[number], np.arange(number))
            weights = band_weights(g.shape[1], reading.mu_r, reading.mu_d)
            rows[at, :number] = combine(g, store.shifts, reading.mode, weights, reading.g_bar)[0]
    row_of = {int(number): at for at, number in enumerate(wanted)}
    out = [_sequence(rows, row_of, int(number), reading) for number in queries]
    return np.stack(out) if out else np.zeros((0, len(profiles)))


def candidate_errors(scores: Array, truth: Truth) -> CandidateErrors:
    """Evaluate scores (Q, N) of the nodes `truth.queries` against all N nodes; the smallest counts as the best match.

    Pairs that are neither the same place nor different ones are not used.
    """
    same, different = scores[truth.same], scores[truth.different]
    pool = np.where(truth.same | truth.different, scores, np.inf)
    asked = np.flatnonzero(np.isfinite(pool).any(axis=1))
    best = np.argmin(pool[asked], axis=1) if len(asked) else np.zeros(0, dtype=np.int64)
    right = truth.same[asked, best]
    revisits = truth.same[asked].any(axis=1)
    precision, recall = _curve(pool[asked, best], right, int(revisits.sum()))
    return CandidateErrors(
        pair_auc=_auc(same, different),
        top1=float(right[revisits].mean()) if revisits.any() else float("nan"),
        average_precision=_average_precision(precision, recall) if revisits.any() else float("nan"),
        recall_full_precision=float(recall[precision == 1.0].max(initial=0.0)) if revisits.any() else float("nan"),
        queries=len(asked),
        revisits=int(revisits.sum()),
        pairs=len(same) + len(different),
    )


def _with_predecessors(queries: Indices, sequence: int) -> Indices:
    before = queries[:, None] - np.arange(sequence)[None]
    return np.unique(before[before >= 0])


def _sequence(rows: Array, row_of: dict[int, int], number: int, reading: Reading) -> Array:
    """Scores (N,) of one view, averaged with those before it."""
    scores: Array = rows[row_of[number]]
    if reading.sequence == 1:
        return scores

    def earlier(back: int, partners: Indices) -> Array:
        return np.asarray(rows[row_of[number - back], partners])

    out: Array = scores.copy()
    out[:number] = in_sequence(scores[:number], np.arange(number), number, reading.sequence, earlier, reading.circular)
    return out


def _auc(same: Array, different: Array) -> float:
    """Probability that a pair of the same place scores less than one of different places; ties count half."""
    if len(same) == 0 or len(different) == 0:
        return float("nan")
    ordered = np.sort(different)
    below = np.searchsorted(ordered, same, side="left")
    tied = np.searchsorted(ordered, same, side="right") - below
    return float(1.0 - np.mean((below + 0.5 * tied) / len(ordered)))


def _curve(scores: Array, right: NDArray[np.bool_], revisits: int) -> tuple[Array, Array]:
    """Precision and recall at each threshold at which the set of accepted matches changes."""
    order = np.argsort(scores, kind="stable")
    hits = np.cumsum(right[order])
    last_of_tie = np.append(np.diff(scores[order]) > 0, True) if len(order) else np.zeros(0, dtype=np.bool_)
    accepted = np.arange(1, len(order) + 1)
    return (hits / accepted)[last_of_tie], (hits / max(revisits, 1))[last_of_tie]


def _average_precision(precision: Array, recall: Array) -> float:
    return float(np.sum(np.diff(recall, prepend=0.0) * precision))


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """The settings of a session by which its scanline profiles are computed and compared.

    Attributes:
        profile: size and normalisation of a profile.
        matching: weights and threshold of the comparison.
        mode: formula of the score G, see `vision.templates.combine`.
        circular: whether the session's laser covers 360 degrees.
    """

    profile: ProfileConfig
    matching: MatchingConfig
    mode: Mode
    circular: bool


def evaluate_loops(folder: Path, reference: Path | None = None) -> list[Metric]:
    """Evaluate how well the views of a session tell its places apart, with the session's own settings.

    Args:
        folder: the session folder.
        reference: ground truth in the TUM format; default: the session's own.

    Returns:
        `pair_auc/<mode>`, `candidate_top1/<mode>`, `candidate_ap/<mode>`, `candidate_recall_full_precision/<mode>`; `<mode>`
        is the formula of the score.

    Raises:
        StoreError: the folder holds no session.
        StreamError: the reference is missing or damaged.
        EvaluationError: there is no ground truth, or the session stores no profiles.
    """
    truth = truth_of(folder, reference)
    with MapStore.open(folder) as store:
        settings = view_settings(store)
        profiles, stamps = stored_profiles(store), node_stamps(store)
    if not profiles:
        raise EvaluationError(f"{folder}: its nodes hold no views, which --loops evaluates; leave --loops out")
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
    errors = candidate_errors(score_matrix(profiles, pairs.queries, reading), pairs)
    return candidate_metrics(mode, errors)


def candidate_metrics(mode: str, errors: CandidateErrors) -> list[Metric]:
    """The errors of one formula of the score as metrics, named `<measure>/<mode>`; `mode` is the name of the formula."""
    views = f"of {counted(errors.revisits, 'revisit')} among {counted(errors.queries, 'view')}"
    rows = [
        ("pair_auc", errors.pair_auc),
        ("candidate_top1", errors.top1),
        ("candidate_ap", errors.average_precision),
        ("candidate_recall_full_precision", errors.recall_full_precision),
    ]
    return [figure(f"{measure}/{mode}", value, pairs=counted(errors.pairs, "pair"), views=views) for measure, value in rows]


def truth_of(folder: Path, reference: Path | None) -> Trajectory:
    """Read the ground truth of a session: the file `reference` in the TUM format, or if it is None the session's own.

    Raises:
        StoreError: the folder holds no session.
        StreamError: the reference is missing or damaged.
        EvaluationError: no reference is given, and the session has none.
    """
    session = SessionFolder(folder)
    session.require()
    if reference is None and not session.groundtruth.is_file():
        raise EvaluationError(f"{folder}: --loops needs ground truth, and the session has none; give --reference GT.tum")
    return read_tum(reference or session.groundtruth)


def view_settings(store: MapStore) -> ViewSettings:
    """Settings with which a session computed its scanline profiles and compared them; missing ones get their defaults."""
    tree: dict[str, Any] = without_gone(store.config_tree).get("vision") or {}
    rgbd = tree.get("rgbd") or {}
    return ViewSettings(
        ProfileConfig.model_validate(tree.get("profile") or {}),
        MatchingConfig.model_validate(tree.get("matching") or {}),
        rgbd.get("matching", "four-band"),
        sees_all_around(store.rig),
    )


def node_stamps(store: MapStore) -> np.ndarray[Any, np.dtype[np.int64]]:
    """(N,) stamps of the nodes of a session's map, ns."""
    return np.array([node.stamp_ns for node in store.map().nodes], dtype=np.int64)


def stored_profiles(store: MapStore) -> list[Profile]:
    """The stored profiles of a session, (bands, width) each, in the order of the nodes; nodes without one are left out."""
    profiles = [store.keyframe(node).get("profile") for node in range(len(store.map()))]
    return [profile for profile in profiles if profile is not None]
