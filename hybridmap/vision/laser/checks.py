"""What a laser's edges are decided by: every check of registrations, hypotheses and clusters, each with its limit."""

from __future__ import annotations

from hybridmap.graph.edges import Check, at_least, at_most

FIT_MIN = "vision.laser.probes.fit_min"
"""The setting that a refused fit names."""
INLIERS_WEAK, INLIERS_MIN = 0.45, 0.6
"""Least share of inliers at which a registration becomes an edge, and at which it is good: half of a view may have changed."""
TRANSLATION_MAX_M = 0.4
"""A registration that is not good and leads farther from the odometry is refused, m: more than a step between nodes slips."""
CONTRADICTION_SIGMAS = 4.0
"""A registration this far from the odometry, in deviations of the odometry, does not show that the robot drove there."""
WAY_VIOLATION = 0.13
"""The odometry alone does not show it either where two consecutive scans see each other's walls, this share, in free space."""
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
"""Scans that lie near each other on the optimised map are registered no farther from where it has them."""


def of_step(inliers: float, off_m: float) -> tuple[Check, ...]:
    """Of the registration of a new node: the share of inliers; only a good one may lie far from the odometry."""
    checks: tuple[Check, ...] = (at_least("inliers", inliers, INLIERS_WEAK),)
    if inliers < INLIERS_MIN:
        checks += (at_most("off_odometry_m", off_m, TRANSLATION_MAX_M),)
    return checks


def of_way(odometry_sigma: float | None, violation: float) -> tuple[Check, ...]:
    """Of whether the robot drove to a new node; the first is None where its scan fits nowhere near."""
    seen = at_most("violation", violation, WAY_VIOLATION)
    if odometry_sigma is None:
        return (seen,)
    return (at_most("odometry_sigma", odometry_sigma, CONTRADICTION_SIGMAS), seen)


def of_fit(near: float, fit: float, fit_min: float) -> tuple[Check, ...]:
    """Of two submaps: how many points of one have a partner in the other, and how many of those lie close."""
    return (
        at_least("near", near, NEAR_MIN),
        at_least("fit", fit, fit_min, FIT_MIN),
    )


def of_gate(off_m: float, off_deg: float, radius_m: float, heading_deg: float) -> tuple[Check, ...]:
    """Of where a hypothesis puts the robot: inside the gate."""
    return (at_most("off_m", off_m, radius_m), at_most("off_deg", off_deg, heading_deg))


def of_place(loosest_m: float, ambiguity: float) -> tuple[Check, ...]:
    """Of how well the walls hold a hypothesis: a bare corridor does not."""
    return (
        at_most("loosest_m", loosest_m, LOOSEST_MAX_M),
        at_most("ambiguity", ambiguity, AMBIGUITY_MAX),
    )


def of_free_space(violation: float) -> tuple[Check, ...]:
    """Of the walls of either submap: they do not lie in the free space of the other."""
    return (at_most("violation", violation, VIOLATION_MAX),)


def of_cluster(probes: int, least: int, span_m: float, least_m: float, rival: float) -> tuple[Check, ...]:
    """Of a cluster of hypotheses: its probes, their travel, and the score of its best rival as a share of its own."""
    return (
        at_least("probes", probes, least),
        at_least("span_m", span_m, least_m),
        at_most("rival", rival, RIVAL),
    )
