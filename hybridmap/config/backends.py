"""Settings of the back-ends."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from hybridmap.config.section import Section


class RelaxationConfig(Section):
    """The paper's correction rule and its stable relatives."""

    theta: float = Field(default=0.5, gt=0, le=1)
    """Correction rate, the paper's vartheta.

    Watch: `relaxation-paper` is stable only below 2 / lambda_max of the graph's Laplacian, which real graphs exceed."""
    theta_decay: float = Field(default=1.0, gt=0, le=1)
    """`relaxation-ratslam`, `-robust`: factor on theta after every sweep of one call.

    Watch: with 1 the last sweeps go round in a limit cycle; far below 1 they stop before the map has settled."""
    sweeps_per_node: int = Field(default=20, ge=1)
    """Sweeps each time the graph has grown.

    Watch: each costs time in proportion to the edges of the whole graph."""
    solve_sweeps: int = Field(default=5000, ge=1)
    """Most sweeps when a whole graph is solved at once.

    Watch: far ends of a long chain need many."""
    on_unstable: Literal["refuse", "normalise", "run"] = "run"
    """`relaxation-paper` where theta is too large: report `diverged` without a sweep, divide theta by each node's degree, or
    run it and report what happened.

    Watch: it never returns a worse map than it got."""


class GncConfig(Section):
    """Graduated non-convexity (truncated least squares) on the loop edges; other edges are known inliers."""

    start: Literal["auto", "batch", "grow"] = "auto"
    """`batch` anneals the whole graph from its initial poses, `grow` adds the nodes by chunks, `auto` grows in two ways (and
    starts from the map at the end of a drive, where there is one) and takes the lowest truncated cost.

    Watch: `auto` takes the most time, and survives worse starts."""
    quantile: float = Field(default=0.99, gt=0.5, lt=1)
    """A loop is an inlier while its squared Mahalanobis residual is below this quantile of chi2 with 3 degrees of freedom.

    Watch: one in a hundred true loops of honest noise lies beyond 0.99."""


class RobustConfig(Section):
    """Kernels on the loop edges, and on the edges of motion where wheels have drop-outs."""

    cauchy_scale: float = Field(default=1.0, gt=0)
    """Whitened residual at which a Cauchy weight of a loop is one half.

    Watch: smaller resists more false loops, and bends less towards true ones after a drift."""
    odometry: Literal["none", "huber", "cauchy", "geman-mcclure"] = "none"
    """Kernel on odometry and registration edges: in `gtsam-isam2`, `gtsam-gnc`, `gtsam-calibrated` and the back-ends named by
    a kernel.

    Watch: edges of a weight below a tenth, and nodes that hang on such edges alone, are in the report."""


class ConsistencyConfig(Section):
    """Pairwise consistency of loops through the chain, judged before a whole graph is solved by any back-end."""

    enabled: bool = False
    """Leave out loops that are not consistent with the others, and try them again from the solution.

    Watch: a true loop with no other near it is left out too."""


class Isam2Config(Section):
    """Incremental smoothing."""

    loop_kernel: Literal["none", "cauchy"] = "none"
    """Kernel on the loop edges."""


class BackendsConfig(Section):
    """Which back-ends follow the graph; the first is the primary and drives `map -> odom`."""

    names: tuple[str, ...] = Field(default=("gtsam-gnc", "relaxation-ratslam"), min_length=1)
    """Names; the first is the primary.

    Watch: every one costs its own time at each node."""
    max_iterations: int = Field(default=100, ge=1)
    """Most iterations of a batch optimiser.

    Watch: a back-end that stops there says so in its report."""
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
