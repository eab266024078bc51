"""A measured value with its name, unit and meaning. One list of them gives the table for people and the JSON for programs."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import Any


@dataclass(frozen=True, slots=True)
class Metric:
    """One measured value.

    Attributes:
        name: `<measure>/<back-end or processing stage>`, e.g. `ate_rmse/gtsam-gnc`.
        value: NaN if it could not be computed.
        unit: `m`, `deg`, `s`, `1`, ...
        description: one line for people.
        bar: the limit that the value must keep, None without one; whether from above or below, the description says.
        passed: whether the value keeps the limit, None without one.
    """

    name: str
    value: float
    unit: str
    description: str
    bar: float | None = None
    passed: bool | None = None

    def to_json(self) -> dict[str, Any]:
        """The metric as a dictionary of JSON values; a value that is not finite becomes null, as JSON has no NaN."""
        row: dict[str, Any] = {
            "name": self.name,
            "value": self.value if math.isfinite(self.value) else None,
            "unit": self.unit,
            "description": self.description,
        }
        if self.bar is not None:
            row |= {"bar": self.bar, "passed": self.passed}
        return row


FIGURES: dict[str, tuple[str, str]] = {
    "nodes": ("1", "nodes of the map"),
    "nodes_reused": ("1", "times that the robot was found at a node that existed, so that none was made"),
    "sessions": ("1", "drives that the map was made of"),
    "pieces": ("1", "pieces of the map that are not joined, each in a frame of its own; 1 if all is one map"),
    "loops_accepted": ("1", "loop closures in the graph"),
    "found_after": ("m", "travel after which the place of the drive on the map was found"),
    "known_on_map": ("1", "share of the poses whose place on the map is known"),
    "loops_between_sessions": ("1", "of those, the ones between two sessions"),
    "loops_pending": ("1", "loop closures still waiting at the end"),
    "loops_rejected": ("1", "loop closures refused, each with its reason"),
    "loops_retracted": ("1", "loop closures that were removed from the graph again"),
    "loops_proposed_by/": ("1", "of the accepted ones, those that were first proposed by {what}"),
    "loops_tried_again": ("1", "outlier loops, measured again on the final map"),
    "loops_readmitted": ("1", "of those, the ones that now agree with it"),
    "odometry_dropped": ("1", "odometry edges that a registration contradicted"),
    "wheels_heading_noise": ("deg/√m", "heading noise of the wheels, learnt from registrations; below 0.5 they are trusted"),
    "wheels_translation_noise": ("m/√m", "noise of the wheels' translation, learnt likewise"),
    "clock_offset": ("s", "{said}"),
    "clock_offset_sigma": ("s", "its standard deviation"),
    "clock_offset_used": ("s", "what of it the map was corrected by"),
    "largest_correction": ("m", "largest shift of a node when the map was corrected"),
    "travel": ("m", "path length by odometry"),
    "duration": ("s", "length of the recording"),
    "unobserved": ("m", "{free}"),
    "cpu_s/": ("s", "process time of {what}"),
    "cpu_s_per_min": ("s/min", "process time a minute of recording"),
    # of a solution
    "chi2_initial/": ("1", "chi2 of the initial poses"),
    "chi2/": ("1", "chi2 at the end, over all edges"),
    "chi2_odometry/": ("1", "share of chi2 from edges other than loops"),
    "unit_variance/": ("1", "chi2 of the inlier edges per degree of freedom; 1 if the stated covariances are right"),
    "iterations/": ("1", "iterations, sweeps or updates"),
    "loops_rejected/": ("1", "accepted loops rejected as outliers by the back-end"),
    "rejected_loops/": ("1", "loop edges rejected as outliers"),
    "rejected_together/": ("1", "of those, the ones that agree with each other"),
    "weak_edges/": ("1", "odometry and registration edges down-weighted to less than a tenth"),
    "hanging_nodes/": ("1", "nodes that only such edges and rejected loops join to the first node"),
    "chi2_bound/": ("1", "proved: no map has a lower chi2 over the inlier edges"),
    "chi2_gap/": ("1", "proved: largest share of this map's chi2 over the inlier edges that another map could save"),
    "certificate_gap/": (
        "1",
        "proved relative gap of the isotropised objective at its optimum near the map, over the inlier edges",
    ),
    # of a trajectory, against the truth
    "ate_rmse/": ("m", "absolute trajectory error after SE(2) alignment, RMSE; {when}"),
    "ate_median/": ("m", "absolute trajectory error, median; {when}"),
    "ate_max/": ("m", "absolute trajectory error, largest; {when}"),
    "ate_poses/": ("1", "poses compared, of {total}; {when}"),
    "rpe_trans/": ("m", "relative pose error over 1 m, translation, RMSE; {when}"),
    "rpe_rot/": ("deg", "relative pose error over 1 m, rotation, RMSE; {when}"),
    "rpe_trans_1s/": ("m", "relative pose error over 1 s, translation, RMSE; {when}"),
    "rpe_rot_1s/": ("deg", "relative pose error over 1 s, rotation, RMSE; {when}"),
    "drift/": ("%", "mean translational error over pieces of 5 to 160 m, of travel; {when}"),
    # of a trajectory, against verified relations
    "relation_trans_mean/": ("m", "translational relation error, mean, {which}; {when}"),
    "relation_trans_std/": ("m", "translational relation error, standard deviation, {which}; {when}"),
    "relation_rot_mean/": ("deg", "rotational relation error, mean, {which}; {when}"),
    "relation_rot_std/": ("deg", "rotational relation error, standard deviation, {which}; {when}"),
    "relation_used/": ("1", "relations used of {total}, {which}; {when}"),
    "relation_loop_trans_mean/": ("m", "translational relation error, mean, {which}; {when}"),
    "relation_loop_trans_std/": (
        "m",
        "translational relation error, standard deviation, {which}; {when}",
    ),
    "relation_loop_rot_mean/": ("deg", "rotational relation error, mean, {which}; {when}"),
    "relation_loop_rot_std/": ("deg", "rotational relation error, standard deviation, {which}; {when}"),
    "relation_loop_used/": ("1", "relations used of {total}, {which}; {when}"),
    # of edges, against the truth
    "loop_precision/": ("1", "share of {judged} within 1 m and 15 deg of truth"),
    "loop_recall/": ("1", "share of the {revisits} with a right loop edge {kept}"),
    "loops_right/": ("1", "right ones of {judged}"),
    "loop_trans_median/": ("m", "translational error of right loop edges, median"),
    "loop_trans_p95/": ("m", "translational error of right loop edges, 95 %"),
    "loop_rot_median/": ("deg", "rotational error of right loop edges, median"),
    "loop_rot_p95/": ("deg", "rotational error of right loop edges, 95 %"),
    "edge_trans_median/": ("m", "translational error of {which}, median"),
    "edge_trans_p95/": ("m", "translational error of {which}, 95 %"),
    "edge_rot_median/": ("deg", "rotational error of {which}, median"),
    "edge_rot_p95/": ("deg", "rotational error of {which}, 95 %"),
    "edge_chi2_ratio/": ("1", "normalised squared error of {which}, median, over the expected median"),
    "edges_wrong/": ("1", "share of {which} that are wrong by more than 1 m"),
    "edges_wrong_kept/": ("1", "of those, how many the primary back-end gave a weight above one half"),
    # of views, before any verification
    "pair_auc/": ("1", "chance that a pair of one place scores better than another, {pairs}"),
    "candidate_top1/": ("1", "share whose best match of all older nodes is the same place, {views}"),
    "candidate_ap/": ("1", "average precision of the best matches, {views}"),
    "candidate_recall_full_precision/": ("1", "recall without a false match, {views}"),
}
"""Every figure of a session and of a solution: measure -> unit and words, in which `figure` fills in what is in braces.

A measure that ends in `/` is of a back-end or stage, whose name follows.
"""

PROVED = {"chi2_bound": True, "chi2_gap": False, "certificate_gap": False}
"""Figures that are proved, and whether they are lower bounds: they are rounded to the safe side."""

ONLINE = "_online"
"""After a measure: of the trajectory that the robot believed at the time."""


def figure(name: str, value: float, **facts: object) -> Metric:
    """Create the metric `name`, with unit and description from the list of known measures.

    Args:
        name: `<measure>` or `<measure>/<back-end or processing stage>`.
        value: NaN if it could not be computed.
        facts: values of what is in braces in the measure's description.

    Raises:
        KeyError: the measure is not in `FIGURES`, or a fact is missing.
    """
    measure, slash, _ = name.partition("/")
    unit, words = FIGURES[measure.removesuffix(ONLINE) + slash]
    return Metric(name, float(value), unit, words.format(**facts))


def proved(value: float, digits: int, *, at_least: bool = False) -> float:
    """A proved upper bound rounded up to so many significant digits, or a lower one (`at_least`) rounded down.

    Rounded to the nearest it could say more than is proved.
    """
    if not math.isfinite(value):
        return value
    rounding = ROUND_FLOOR if at_least else ROUND_CEILING
    return float(Context(prec=digits, rounding=rounding).create_decimal(Decimal(float(value))))


def to_json(head: dict[str, Any], metrics: Iterable[Metric]) -> str:
    """Return the text of a JSON object: the keys of `head`, and the list `metrics`."""
    return json.dumps({**head, "metrics": [metric.to_json() for metric in metrics]}, indent=2)


class StageClock:
    """Measures the CPU time of each processing stage; results never depend on it.

    Attributes:
        cpu_s: stage -> seconds. Time in a nested stage counts only there, so the sum is the time of all stages.
    """

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}
        self._within: list[float] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context manager: add the CPU time of the block to a stage, without the time of stages nested in it."""
        self._within.append(0.0)
        start = time.process_time()
        try:
            yield
        finally:
            spent = time.process_time() - start
            self.cpu_s[name] = self.cpu_s.get(name, 0.0) + spent - self._within.pop()
            if self._within:
                self._within[-1] += spent
