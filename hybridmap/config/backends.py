"""Settings of the back-ends."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from hybridmap.config.section import Section


class RelaxationConfig(Section):
    """Settings of map relaxation: the paper's correction rule and its stable variants."""

    theta: float = Field(default=0.5, gt=0, le=1)
    """Correction rate, the paper's vartheta.

    Watch: `relaxation-paper` is stable only below 2 / lambda_max of the graph's Laplacian, which real graphs exceed."""
    theta_decay: float = Field(default=1.0, gt=0, le=1)
    """`relaxation-ratslam`, `-robust`, and `-weighted` while driving: factor on theta after every sweep of one call.

    Watch: with 1 the last sweeps end in a limit cycle; far below 1 they stop before the map has converged.
    """
    sweeps_per_node: int = Field(default=20, ge=1, le=10_000)
    """Sweeps after each growth of the graph.

    Watch: the time of a sweep grows with the edges of the whole graph.
    """
    solve_sweeps: int = Field(default=5000, ge=1, le=10_000_000)
    """Most sweeps when a whole graph is solved at once; the last third of them is at a falling rate in `relaxation-weighted`.

    Watch: a long chain needs many.
    """
    on_unstable: Literal["refuse", "normalise", "run"] = "run"
    """`relaxation-paper` if theta is too large: report `diverged` without a sweep, divide theta by each node's degree, or run
    and report the outcome.

    Watch: in no case is a worse map returned than the initial one.
    """


class GncConfig(Section):
    """Graduated non-convexity (truncated least squares) on the loop edges; all other edges count as inliers."""

    start: Literal["auto", "batch", "grow"] = "auto"
    """Where graduated non-convexity starts. `batch`: on the whole graph at its initial poses. `grow`: chunk by chunk of nodes,
    and at the end of a drive on the map built so far. `auto`: in these and more ways; the lowest truncated cost wins.

    Watch: `auto` takes the most time, and tolerates worse initial poses.
    """
    quantile: float = Field(default=0.99, gt=0.5, lt=1)
    """A loop is an inlier if its squared Mahalanobis residual is below this quantile of chi2 with 3 degrees of freedom.

    Watch: with 0.99, one in a hundred true loops with correct covariance is rejected.
    """


class RobustConfig(Section):
    """Robust kernels on the loop edges, and on odometry and registration edges if wheels have drop-outs."""

    cauchy_scale: float = Field(default=1.0, ge=1e-6, le=1e6)
    """Whitened residual at which the Cauchy weight of a loop is one half.

    Watch: a smaller scale resists more false loops, and follows true loops less after drift.
    """
    odometry: Literal["none", "huber", "cauchy", "geman-mcclure"] = "none"
    """Kernel on odometry and registration edges, used by `gtsam-isam2`, `gtsam-gnc`, `gtsam-calibrated` and the back-ends named
    after a kernel.

    Watch: the report lists edges with a weight below a tenth, and counts nodes that only such edges hold.
    """


class ConsistencyConfig(Section):
    """Filter before a back-end solves a whole graph: loops must be pairwise consistent, given the odometry between them."""

    enabled: bool = False
    """Leave out loops that are not consistent with others, and test them again against the solution.

    Watch: a true loop without another one nearby is left out as well.
    """


class Isam2Config(Section):
    """Settings of incremental smoothing (iSAM2)."""

    loop_kernel: Literal["none", "cauchy"] = "none"
    """Kernel on the loop edges."""


class BackendsConfig(Section):
    """The back-ends that optimise the graph while the robot drives.

    The first one is the primary back-end: it sets the robot's pose (`map -> odom`).
    """

    names: tuple[str, ...] = Field(default=("gtsam-gnc", "relaxation-ratslam"), min_length=1)
    """Names of the back-ends; the first is the primary one. An unknown name gives the list.

    Watch: each back-end takes its own time at every node.
    """
    max_iterations: int = Field(default=100, ge=1, le=1_000_000)
    """Most iterations of a batch optimiser.

    Watch: a back-end that stops at the limit says so in its report.
    """
    relaxation: RelaxationConfig = RelaxationConfig()
    """Relaxation rules."""
    robust: RobustConfig = RobustConfig()
    """Robust kernels."""
    gnc: GncConfig = GncConfig()
    """Graduated non-convexity."""
    consistency: ConsistencyConfig = ConsistencyConfig()
    """Pairwise consistency of the loops."""
    isam2: Isam2Config = Isam2Config()
    """Incremental smoothing."""

    @field_validator("names")
    @classmethod
    def _once_each(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for position, name in enumerate(names):
            if name in names[:position]:
                raise ValueError(f"expected each back-end once, found {name!r} again")
        return names
