"""The checks that decide about edges of a laser, with their limits: registrations, hypotheses, clusters."""

from __future__ import annotations

from hybridmap.graph.edges import Check, at_least, at_most

FIT_MIN = "vision.laser.probes.fit_min"
"""The setting of the limit of `fit`."""
INLIERS_WEAK, INLIERS_MIN = 0.45, 0.6
"""Least share of inliers at which a registration becomes an edge, and at which it is good: half of a view may have changed."""
TRANSLATION_MAX_M = 0.4
"""Largest distance of a registration that is not good from the odometry, m: more than wheels slip between nodes."""
CONTRADICTION_SIGMAS = 4.0
"""A registration farther from the odometry, in standard deviations, is a sign of a break of the chain."""
WAY_VIOLATION = 0.13
"""So is a larger share of the walls of two consecutive scans in each other's free space."""
NEAR_MIN = 0.5
"""Least share of the probe's points that lie near the target: half of the last metres must have been seen before."""
LOOSEST_MAX_M = 0.1
"""Largest standard deviation of the registration in any direction, m: a bare corridor is refused."""
AMBIGUITY_MAX = 0.9
"""Largest share of the likelihood that is left after a shift along the direction that the walls hold least."""
VIOLATION_MAX = 0.15
"""Largest share of points of one submap in the free space of the other, either way: people and doors give a few per cent."""
RIVAL = 0.75
"""The best rival cluster must score less than this share of the cluster."""
OFF_MAX_M, OFF_MAX_DEG = 1.0, 10.0
"""Largest distance of a re-proposed registration from the optimised map, m and degrees."""


def of_step(inliers: float, off_m: float) -> tuple[Check, ...]:
    """Registration of a new node: share of inliers; only a good one may contradict the odometry."""
    checks: tuple[Check, ...] = (at_least("inliers", inliers, INLIERS_WEAK),)
    if inliers < INLIERS_MIN:
        checks += (at_most("off_odometry_m", off_m, TRANSLATION_MAX_M),)
    return checks


def of_way(odometry_sigma: float | None, violation: float) -> tuple[Check, ...]:
    """Whether the robot drove to a new node; `odometry_sigma` is None where its scan fits nowhere near."""
    seen = at_most("violation", violation, WAY_VIOLATION)
    if odometry_sigma is None:
        return (seen,)
    return (at_most("odometry_sigma", odometry_sigma, CONTRADICTION_SIGMAS), seen)


def of_fit(near: float, fit: float, fit_min: float) -> tuple[Check, ...]:
    """Two submaps: share of points with a partner, and of inliers among those."""
    return (
        at_least("near", near, NEAR_MIN),
        at_least("fit", fit, fit_min, FIT_MIN),
    )


def of_gate(off_m: float, off_deg: float, radius_m: float, heading_deg: float) -> tuple[Check, ...]:
    """Pose of a hypothesis: inside the gate."""
    return (at_most("off_m", off_m, radius_m), at_most("off_deg", off_deg, heading_deg))


def of_place(loosest_m: float, ambiguity: float) -> tuple[Check, ...]:
    """Certainty of a hypothesis: in a bare corridor it is loose or ambiguous."""
    return (
        at_most("loosest_m", loosest_m, LOOSEST_MAX_M),
        at_most("ambiguity", ambiguity, AMBIGUITY_MAX),
    )


def of_free_space(violation: float) -> tuple[Check, ...]:
    """Walls of either submap: not in the free space of the other."""
    return (at_most("violation", violation, VIOLATION_MAX),)


def of_cluster(probes: int, least: int, span_m: float, least_m: float, rival: float) -> tuple[Check, ...]:
    """A cluster of hypotheses: its probes, their travel, and the score of its best rival as a share of its own."""
    return (
        at_least("probes", probes, least),
        at_least("span_m", span_m, least_m),
        at_most("rival", rival, RIVAL),
    )
