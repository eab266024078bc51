"""Relaxation link by link, in place, with headings, in which the covariances of the links are the weights.

With a constant rate a link that is ten times surer than the others pulls no harder: a sweep ends in a cycle in which each
link has the last word once. So a link that is less sure than the motion gets a smaller rate, in proportion to its inverse
variance, and at the end of a solution the rate falls, so that the cycle shrinks to the point that all weights agree on.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from hybridmap.backends.base import Outcome
from hybridmap.backends.driver import Driver, Works
from hybridmap.backends.objective import chi2
from hybridmap.backends.relaxation.ratslam import outcome_of, relax_links, swept
from hybridmap.config.backends import BackendsConfig, RelaxationConfig
from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

FALLING_PART = 3
"""One in so many sweeps of a solution has a falling rate, the last ones. A rate that falls from the start is too small before
the ends of the drive have met."""
LAST_RATE = 0.0025
"""What is left of the rate after the last sweep: that of a factor of 0.998 a sweep over 3,000 sweeps. What the cycle of a
sweep adds to the optimum shrinks with the rate."""


def weighted(name: str, config: BackendsConfig) -> Driver:
    """A back-end with RatSLAM's rule and a rate for each link's position and heading by its variance (`shares`).

    An update runs a few sweeps, as with the other rules. The end of a drive is a whole solution from the map of the drive, or
    from the graph's initial poses where these fit it better, as when the odometry was measured again.
    """
    rules = config.relaxation
    solve = swept(partial(_settled, rules), rules.solve_sweeps)

    def onward(graph: PoseGraph, driven: Array) -> Outcome:
        return solve(graph, driven if chi2(graph, driven) <= chi2(graph, graph.initial) else graph.initial)

    follow = swept(partial(_followed, rules), rules.sweeps_per_node)
    return Driver(name, config, solve, follow=follow, onward=onward, works=Works.ON_GROWTH)


def shares(graph: PoseGraph) -> Array:
    """Factors (E, 2) in (0, 1] on the rate of each link, for position and heading: min(1, usual variance / own variance).

    Usual is the median of the edges of motion, odometry and registrations; without any, that of all edges. The variance of a
    position is the mean of those of x and y: the rule moves both alike, in the world frame, where only their sum does not
    depend on the heading. Links that are surer than usual get 1: rates above theta are not stable. A smaller usual variance
    would tell sure links apart, but a chain of links with small rates takes ever more sweeps to bend.

    Args:
        graph: a valid one with one edge or more.
    """
    variances = _variances(graph.information)
    usual = variances[graph.is_motion] if graph.is_motion.any() else variances
    return np.asarray(np.minimum(1.0, np.median(usual, axis=0) / variances))


def _variances(information: Array) -> Array:
    """Variances (E, 2) of position, the mean of x and y, and of heading, m^2 and rad^2, from information (E, 3, 3)."""
    xx, xy, xt, _, yy, yt, _, _, tt = information.reshape(-1, 9).T
    of_x, of_y, of_t = yy * tt - yt * yt, xx * tt - xt * xt, xx * yy - xy * xy
    determinant = xx * of_x - xy * (xy * tt - yt * xt) + xt * (xy * yt - yy * xt)
    regular = determinant > 0.0  # not so by rounding where a matrix is nearly singular
    scale = np.where(regular, 1.0 / np.where(regular, determinant, 1.0), 0.0)
    x, y, t = (np.maximum(minor * scale, 1.0 / own) for minor, own in ((of_x, xx), (of_y, yy), (of_t, tt)))
    return np.column_stack([0.5 * (x + y), t])


def _followed(config: RelaxationConfig, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
    return outcome_of(relax_links(graph, start, sweeps, config, shares=shares(graph)))


def _settled(config: RelaxationConfig, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
    """Sweeps at a constant rate until nothing moves, then sweeps at a falling one; `sweeps` at most."""
    falling = sweeps // FALLING_PART
    each, constant = shares(graph), config.model_copy(update={"theta_decay": 1.0})
    relaxed = relax_links(graph, start, sweeps - falling, constant, shares=each)
    if not falling or not np.isfinite(relaxed.poses).all():
        return outcome_of(relaxed)
    decaying = config.model_copy(update={"theta_decay": LAST_RATE ** (1.0 / falling)})
    last = relax_links(graph, relaxed.poses, falling, decaying, shares=each, settles=False)
    outcome = outcome_of(relaxed)
    return Outcome(
        last.poses,
        outcome.status,
        f"{outcome.message}; then {counted(falling, 'sweep')} at a falling rate",
        relaxed.sweeps + last.sweeps,
    )
