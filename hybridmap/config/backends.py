"""Settings of the back-ends."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from hybridmap.config.section import Section


class RelaxationConfig(Section):
    """The paper's correction rule and its stable relatives."""

    theta: float = Field(default=0.5, gt=0, le=1)
    """Correction rate, the paper's vartheta."""
    theta_decay: float = Field(default=1.0, gt=0, le=1)
    """`relaxation-ratslam`, `-robust`: factor on theta after every sweep of one call; below 1 it removes the limit cycle."""
    sweeps_per_node: int = Field(default=20, ge=1)
    """Sweeps each time the graph has grown."""
    solve_sweeps: int = Field(default=5000, ge=1)
    """Most sweeps when a whole graph is solved at once."""
    tolerance_m: float = Field(default=1e-6, ge=0)
    """A sweep that moves no node by more (m; 1 rad counts as 1 m) ends the relaxation."""
    robust_scale_m: float = Field(default=0.3, gt=0)
    """`relaxation-robust`: error of position at which a loop's correction is a quarter of the plain one (m)."""
    robust_scale_rad: float = Field(default=0.1, gt=0)
    """The same of heading (rad)."""
    robust_start: float = Field(default=8.0, ge=1)
    """Factor on both scales at the first sweep of a call, from which they shrink to themselves."""
    on_unstable: Literal["refuse", "normalise", "run"] = "run"
    """`relaxation-paper` where theta >= theta_max = 2/lambda_max: report `diverged` without a sweep, divide theta by each
    node's degree, or run it and report what happened. It never returns a worse map than it got."""


class GncConfig(Section):
    """Graduated non-convexity (truncated least squares) on the loop edges; other edges are known inliers."""

    start: Literal["auto", "batch", "grow"] = "auto"
    """`batch` anneals the whole graph from its initial poses, `grow` adds the nodes by chunks, `auto` grows in two ways (and
    starts from the map at the end of a drive, where there is one) and takes the lowest truncated cost."""
    chunk_nodes: int = Field(default=500, ge=10)
    """`grow`: nodes a chunk."""
    mu_factor: float = Field(default=4.0, gt=1)
    """Growth of the control parameter mu from round to round."""
    max_rounds: int = Field(default=60, ge=1)
    """Most rounds of weights and one step."""
    quantile: float = Field(default=0.99, gt=0.5, lt=1)
    """A loop is an inlier while its squared Mahalanobis residual is below this quantile of chi2 with 3 degrees of freedom."""


class RobustConfig(Section):
    """Kernels on the loop edges, and on the edges of motion where wheels have drop-outs."""

    cauchy_scale: float = Field(default=1.0, gt=0)
    """Whitened residual at which a Cauchy weight is one half."""
    huber_scale: float = Field(default=1.345, gt=0)
    """Whitened residual from which a Huber cost is linear."""
    dcs_phi: float = Field(default=1.0, gt=0)
    """Dynamic covariance scaling: squared whitened residual from which a loop is scaled down."""
    geman_mcclure_scale: float = Field(default=2.0, gt=0)
    """Whitened residual at which a Geman-McClure weight is a quarter."""
    odometry: Literal["none", "huber", "cauchy", "geman-mcclure"] = "none"
    """Kernel on odometry and registration edges: in `gtsam-isam2`, `gtsam-gnc`, `gtsam-calibrated` and the back-ends named by
    a kernel. Edges that it gives a weight below a tenth, and nodes that hang on such edges alone, are in the report."""
    odometry_scale: float = Field(default=1.0, gt=0)
    """Whitened residual at which that kernel's weight is a half (Cauchy) or a quarter, or from which its cost is linear."""


class ConsistencyConfig(Section):
    """Pairwise consistency of loops through the chain, judged before a whole graph is solved by any back-end."""

    enabled: bool = False
    """Leave out loops that are not consistent with the others, and try them again from the solution."""
    quantile: float = Field(default=0.99, gt=0.5, lt=1)
    """Two loops agree while their squared Mahalanobis distance is below this quantile of chi2 with 3 degrees of freedom."""
    neighbours: int = Field(default=1, ge=0)
    """Loops between the same places, within 10 nodes at both ends, that each must agree with."""


class Isam2Config(Section):
    """Incremental smoothing."""

    loop_kernel: Literal["none", "cauchy"] = "none"
    """Kernel on the loop edges."""
    patience: float = Field(default=0.5, ge=0)
    """Closures wait while together they could move no pose by more than this many of its standard deviations."""
    relinearize_m: float = Field(default=0.1, gt=0)
    """Largest step of a variable's position (m) before it is linearised anew; edges bend with headings, not with positions."""
    relinearize_rad: float = Field(default=0.01, gt=0)
    """The same of its heading (rad)."""
    settle_updates: int = Field(default=10, ge=0)
    """Most empty updates after the first one and after an edge was removed; they end when nothing is linearised anew."""


class BackendsConfig(Section):
    """Which back-ends follow the graph; the first is the primary and drives `map -> odom`."""

    names: tuple[str, ...] = Field(default=("gtsam-gnc", "relaxation-ratslam"), min_length=1)
    """Names; the first is the primary."""
    max_iterations: int = Field(default=100, ge=1)
    """Most iterations of a batch optimiser."""
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
