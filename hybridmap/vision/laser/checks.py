"""What a laser's edges are decided by: every check of registrations, hypotheses and clusters, each with its limit."""

from __future__ import annotations

from hybridmap.config.laser import CommitmentConfig, LaserRelocalisingConfig, ProbeConfig, TrackingConfig
from hybridmap.graph.edges import Check, at_least, at_most

_TRACKING, _PROBES = "vision.laser.tracking", "vision.laser.probes"
_COMMITMENT, _RELOCALISING = "vision.laser.commitment", "vision.laser.relocalising"
OFF_MAX_M, OFF_MAX_DEG = 1.0, 10.0
"""Scans that lie near each other on the optimised map are registered no farther from where it has them."""


def of_step(inliers: float, off_m: float, c: TrackingConfig) -> tuple[Check, ...]:
    """Of the registration of a new node: the share of inliers; only a good one may lie far from the odometry."""
    checks: tuple[Check, ...] = (at_least("inliers", inliers, c.inliers_weak, f"{_TRACKING}.inliers_weak"),)
    if inliers < c.inliers_min:
        checks += (at_most("off_odometry_m", off_m, c.translation_max_m, f"{_TRACKING}.translation_max_m"),)
    return checks


def of_way(odometry_sigma: float | None, violation: float, c: LaserRelocalisingConfig) -> tuple[Check, ...]:
    """Of whether the robot drove to a new node; the first is None where its scan fits nowhere near."""
    seen = at_most("violation", violation, c.violation, f"{_RELOCALISING}.violation")
    if odometry_sigma is None:
        return (seen,)
    limit = f"{_RELOCALISING}.contradiction_sigmas"
    return (at_most("odometry_sigma", odometry_sigma, c.contradiction_sigmas, limit), seen)


def of_fit(near: float, fit: float, c: ProbeConfig) -> tuple[Check, ...]:
    """Of two submaps: how many points of one have a partner in the other, and how many of those lie close."""
    return (
        at_least("near", near, c.near_min, f"{_PROBES}.near_min"),
        at_least("fit", fit, c.fit_min, f"{_PROBES}.fit_min"),
    )


def of_gate(off_m: float, off_deg: float, radius_m: float, heading_deg: float) -> tuple[Check, ...]:
    """Of where a hypothesis puts the robot: inside the gate."""
    return (at_most("off_m", off_m, radius_m), at_most("off_deg", off_deg, heading_deg))


def of_place(loosest_m: float, ambiguity: float, c: ProbeConfig) -> tuple[Check, ...]:
    """Of how well the walls hold a hypothesis: a bare corridor does not."""
    return (
        at_most("loosest_m", loosest_m, c.loosest_max_m, f"{_PROBES}.loosest_max_m"),
        at_most("ambiguity", ambiguity, c.ambiguity_max, f"{_PROBES}.ambiguity_max"),
    )


def of_free_space(violation: float, c: ProbeConfig) -> tuple[Check, ...]:
    """Of the walls of either submap: they do not lie in the free space of the other."""
    return (at_most("violation", violation, c.violation_max, f"{_PROBES}.violation_max"),)


def of_cluster(probes: int, least: int, span_m: float, least_m: float, rival: float, c: CommitmentConfig) -> tuple[Check, ...]:
    """Of a cluster of hypotheses: its probes, their travel, and the score of its best rival as a share of its own."""
    return (
        at_least("probes", probes, least, f"{_COMMITMENT}.probes"),
        at_least("span_m", span_m, least_m, f"{_COMMITMENT}.span_m"),
        at_most("rival", rival, c.rival, f"{_COMMITMENT}.rival"),
    )
