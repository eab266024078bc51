"""The checks that decide about edges of a laser, with their limits: registrations, hypotheses, clusters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from hybridmap.graph.edges import Check, Need, at_least, at_most

FIT_MIN = "vision.laser.probes.fit_min"
"""The setting of the limit of `fit`."""
INLIERS_WEAK, INLIERS_MIN = 0.45, 0.6
"""Least share of inliers at which a registration becomes an edge, and at which it is good: half of a view may have changed."""
INLIERS_HINT = 0.25
"""Least share of inliers at which scans after a break hint at where the robot is; at another place it is about 0.1."""
TRANSLATION_MAX_M = 0.4
"""Largest distance of a registration that is not good from the odometry, m: more than wheels slip between nodes."""
CONTRADICTION_SIGMAS = 4.0
"""A registration farther from the odometry, in standard deviations, is a sign of a break of the chain."""
WAY_VIOLATION = 0.13
"""So is a larger share of the walls of two consecutive scans in each other's free space."""
RESUMED_VIOLATION = 0.25
"""Largest share of walls in free space at which scans after a break fit those before it: bad scans lie on either side of it."""
NEAR_MIN = 0.5
"""Least share of the probe's points that lie near the target: half of the last metres must have been seen before."""
LOOSEST_MAX_M = 0.1
"""Largest standard deviation of the registration in any direction, m: a bare corridor is refused."""
AMBIGUITY_MAX = 0.9
"""Largest share of the likelihood that is left after a shift along the direction that the walls hold least."""
VIOLATION_MAX = 0.15
"""Largest share of points of one submap in the free space of the other, either way: people and doors give a few per cent."""
HAIR_SIGMAS = 1.0
"""A share misses its limit by a hair if it is so near, in standard errors of the share: it may as well have kept it."""
PIECES_MIN = 10
"""Fewest things in sight of which a share has a standard error worth the name: two or three trees tell nothing."""
RIVAL = 0.75
"""The best rival cluster must score less than this share of the cluster."""
FIT_ELSEWHERE_MAX = 1.0
"""Scans that fit elsewhere better by more than this, summed, were taken there: as much as one that fits there and not here."""
OFF_MAX_M, OFF_MAX_DEG = 1.0, 10.0
"""Largest distance of a re-proposed registration from the optimised map, m and degrees."""


def of_step(inliers: float, off_m: float) -> tuple[Check, ...]:
    """Check the registration of a new node: share of inliers; below `INLIERS_MIN`, also the distance from the odometry.

    Args:
        inliers: measured share of the scan's points that fit, 0..1.
        off_m: distance of the registered position from that by the odometry, m.
    """
    checks: tuple[Check, ...] = (at_least("inliers", inliers, INLIERS_WEAK),)
    if inliers < INLIERS_MIN:
        checks += (at_most("off_odometry_m", off_m, TRANSLATION_MAX_M),)
    return checks


def of_way(odometry_sigma: float | None, violation: float) -> tuple[Check, ...]:
    """Check whether the robot can have driven from one node to the next.

    Args:
        odometry_sigma: distance between registration and odometry, standard deviations; None if the scan fits nowhere nearby,
            and then it is not checked.
        violation: measured share of the walls of the two scans in each other's free space, 0..1; the limit is `WAY_VIOLATION`.
    """
    seen = at_most("violation", violation, WAY_VIOLATION)
    if odometry_sigma is None:
        return (seen,)
    return (at_most("odometry_sigma", odometry_sigma, CONTRADICTION_SIGMAS), seen)


def of_resumption(inliers: float, inliers_min: float, loosest_m: float, violation: float) -> tuple[Check, ...]:
    """Check whether scans after a break of the chain fit the scans before it so well that they tell where the robot is.

    Args:
        inliers: measured share of their points that fit the submap before the break, 0..1.
        inliers_min: least share that passes.
        loosest_m: largest standard deviation of the position in any direction, m; the limit is `LOOSEST_MAX_M`.
        violation: measured share of the walls of both in each other's free space, 0..1; the limit is `RESUMED_VIOLATION`.
    """
    return (
        at_least("inliers", inliers, inliers_min),
        at_most("loosest_m", loosest_m, LOOSEST_MAX_M),
        at_most("violation", violation, RESUMED_VIOLATION),
    )


def of_fit(near: float, fit: float, fit_min: float) -> tuple[Check, ...]:
    """Check the registration of two submaps.

    Args:
        near: measured share of the points that have a partner in the other submap, 0..1.
        fit: measured share of inliers among the points that have a partner, 0..1.
        fit_min: least `fit` that passes.
    """
    return (
        at_least("near", near, NEAR_MIN),
        at_least("fit", fit, fit_min, FIT_MIN),
    )


def of_gate(off_m: float, off_deg: float, radius_m: float, heading_deg: float) -> tuple[Check, ...]:
    """Check that a registered pose is near the expected one.

    Args:
        off_m, off_deg: measured distance from the expected position and heading.
        radius_m, heading_deg: largest distances that pass.
    """
    return (at_most("off_m", off_m, radius_m), at_most("off_deg", off_deg, heading_deg))


def of_place(loosest_m: float, ambiguity: float) -> tuple[Check, ...]:
    """Check that a registration is certain and unique; in a bare corridor it is neither.

    Args:
        loosest_m: largest standard deviation of the position in any direction, m.
        ambiguity: likelihood of the second-best position as a share of the best one's.
    """
    return (
        at_most("loosest_m", loosest_m, LOOSEST_MAX_M),
        at_most("ambiguity", ambiguity, AMBIGUITY_MAX),
    )


def of_free_space(violation: float) -> tuple[Check, ...]:
    """Check that hardly any walls of one submap lie in the free space of the other.

    `violation` is the measured share, 0..1; the limit is `VIOLATION_MAX`.
    """
    return (at_most("violation", violation, VIOLATION_MAX),)


def loosened(checks: Sequence[Check], pieces: int) -> tuple[Check, ...]:
    """The same checks, with the limits of shares made easier by one standard error of the share.

    Of n independent things that fit with probability p, a share fits whose standard error is sqrt(p (1 - p) / n). Few returns
    in the open, from trees and poles, tell less than the walls of a room, however many points they have.

    Args:
        checks: of a registration of two submaps; only the limits of `near`, `fit` and `violation` move.
        pieces: n, the number of separate things that were seen; with fewer than `PIECES_MIN` no limit moves.
    """
    return tuple(_by_a_hair(check, pieces) if check.figure in ("near", "fit", "violation") else check for check in checks)


def unexpected(failed: Sequence[Check]) -> bool:
    """Whether all failed checks are of the gate: the scans fit, but not where the map expected it."""
    return all(check.figure in ("off_m", "off_deg") for check in failed)


def of_division(better: float) -> tuple[Check, ...]:
    """Check whether the scans after a node fit the map where the chain has them.

    `better` is the measured share of a scan by which they fit better where loops put the robot, summed over these scans.
    """
    return (at_most("fit_elsewhere", better, FIT_ELSEWHERE_MAX),)


def _by_a_hair(check: Check, pieces: int) -> Check:
    hair = HAIR_SIGMAS * math.sqrt(check.limit * (1.0 - check.limit) / pieces) if pieces >= PIECES_MIN else 0.0
    return replace(check, limit=check.limit - hair if check.needs is Need.AT_LEAST else check.limit + hair)


def of_cluster(probes: float, least: int, span_m: float, least_m: float, rival: float) -> tuple[Check, ...]:
    """Check a cluster of loop hypotheses that agree with each other.

    Args:
        probes: number of places along the drive from which the cluster's loops were measured; a place counts half whose loop
            missed a limit by a hair.
        least: least number of them that passes.
        span_m: travel between the first and the last of them, m.
        least_m: least travel that passes, m.
        rival: score of the best contradicting cluster as a share of this cluster's score; 0 if there is none.
    """
    return (
        at_least("probes", probes, least),
        at_least("span_m", span_m, least_m),
        at_most("rival", rival, RIVAL),
    )
