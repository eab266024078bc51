"""Settings of the map: path integration cells, creation of nodes, noise of edges, and online calibration of odometry."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from hybridmap.config.section import Section


class PlaceConfig(Section):
    """Place cells that learn from the grid cells, and the attractor sheet to which they project."""

    attractor_side: int = Field(default=32, ge=8, le=256)
    """Cells along a side of the place attractor; the place code has side * side entries.

    Watch: the time of a step and the size of a node in the map file grow with side * side.
    """
    attractor_cell_m: float = Field(default=0.16, ge=0.01, le=10)
    """Size of one cell of the place attractor, m.

    Watch: the sheet repeats after side * size metres; the place code resolves about three cells.
    """
    learning_rate: float = Field(default=0.0005, ge=0, le=1)
    """eta of the Hebbian rule, per learning step.

    Watch: fields drift towards where the robot is most often."""
    attractor_input: float = Field(default=0.0, ge=0, lt=1)
    """Share of the attractor's activity that the place cells' input sets at each learning step.

    Watch: with 0 only self-motion moves the attractor.
    """


class NeuralConfig(Section):
    """The neural path integrator: head-direction cells -> band cells -> grid cells -> place cells -> place attractor."""

    head_direction_cells: int = Field(default=360, ge=8, le=100_000)
    """m, cells of the head-direction ring.

    Watch: the heading is exact with any number; more cells only average out more noise.
    """
    modules: int = Field(default=8, ge=0, le=32)
    """M, number of grid modules, 3 or more; their spacings form a geometric series between the two limits. 0: no cells at all,
    the odometry is composed as numbers (for comparison).

    Watch: with fewer, the position code repeats sooner; the time of a step grows with the number.
    """
    sheet_side: int = Field(default=32, ge=12, le=128, multiple_of=4)
    """Cells along a side of a grid sheet.

    Watch: the time of a step grows with side * side.
    """
    spacing_min_m: float = Field(default=0.12, ge=0.02, le=100)
    """Grid spacing of the finest module, m.

    Watch: a step of the odometry must be well below half of this spacing.
    """
    spacing_max_m: float = Field(default=0.52, ge=0.02, le=100)
    """Grid spacing of the coarsest module, m.

    Watch: place fields must be narrower than a quarter of this spacing.
    """
    metric: Literal["hexagonal", "square"] = "hexagonal"
    """Metric of the sheets; `square` has bands at 0 and 90 degrees and fires on a square lattice (for comparison)."""
    rectifier: Literal["relu", "softplus"] = "relu"
    """f of the grid sheets: `relu` is the paper's, `softplus` is more accurate.

    Watch: `softplus` makes a step slower.
    """
    kernel: Literal["two-amplitudes", "printed"] = "two-amplitudes"
    """Recurrent weights: a difference of two Gaussians, each with its own amplitude, or with the paper's single amplitude.

    Watch: the printed kernel is unstable with one step per time constant; it is refused, with the instability named.
    """
    band_drive: float = Field(default=0.1, ge=0, le=1)
    """Gain of the band cells' excitatory input to the sheets; the uniform input is 1.

    Watch: with 0 and `relu` the motion of a slow robot is lost.
    """
    neuron_noise: float = Field(default=0.0, ge=0, le=0.5)
    """Standard deviation of the multiplicative noise on the rate of every updated cell; 0.05 is 5 %.

    Watch: the integrated pose drifts; 5 % costs about 0.3 m in 40 m.
    """
    gain: float = Field(default=1.0, gt=0, le=10)
    """k_m, metres of path integration per metre of odometry.

    Watch: `hybridmap calibrate` finds this and the next two.
    """
    turn_gain: float = Field(default=1.0, gt=0, le=10)
    """k_w, radians of path integration per radian of odometry.

    Watch: an error of 1 % is 3.6 degrees per full turn.
    """
    heading_bias_rad_m: float = Field(default=0.0, ge=-1, le=1)
    """Radians added to the heading for each metre driven forward.

    Watch: on a long drive this matters more than the two gains.
    """
    reanchor_weight: float = Field(default=0.0, ge=0, le=1)
    """How far a loop closure pulls the cells to the activity stored at the matched node, shifted by the measured relative pose.

    Watch: 1 replaces the activity, 0 leaves the cells alone; after a false closure the cells show a wrong place. The pose in
    `odom` stays continuous either way.
    """
    place: PlaceConfig = PlaceConfig()
    """Place cells and place attractor."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if 0 < self.modules < 3:
            raise ValueError(f"expected 3 modules or more, or 0 for no cells, found {self.modules}")
        if self.spacing_min_m > self.spacing_max_m:
            found = f"{self.spacing_min_m:g} and {self.spacing_max_m:g}"
            raise ValueError(f"expected spacing_min_m not above spacing_max_m, found {found}")
        return self


class NodesConfig(Section):
    """When a new node is added to the map."""

    rule: Literal["travel", "every-visit", "novelty", "passage", "views"] = "travel"
    """`travel`: after some distance or rotation, but not where four earlier visits left nodes and the view fits one of them:
    there the map grows no more; `every-visit`: the same, there too; `novelty`: the paper's rule, by place code and view
    template, against every node; `passage`: the same against the newest node alone, place code and head direction together;
    `views`: by the views alone, for a new view template or, with `vision.closing.by: ratslam`, another experience.

    Watch: under `novelty` a known place makes no node, and hence no loop closure; under `passage` it makes one at each visit.
    `views` makes nodes by nothing else: it needs a sensor, and by laser `vision.laser.scan.templates` (not with `ratslam` and
    `scanline`).
    """
    distance_m: float = Field(default=0.25, gt=0, le=1000)
    """`travel`: distance between nodes, m.

    Watch: time grows with the number of nodes; with a large distance consecutive views overlap too little.
    """
    angle_deg: float = Field(default=15.0, gt=0, le=180)
    """`travel`: rotation between nodes, degrees.

    Watch: keep it well below a camera's field of view.
    """
    place_threshold: float = Field(default=0.4, gt=0, le=1)
    """`novelty`, `passage`: S_th. A node is made if its place code differs by at least this (1 - cosine).

    Watch: a smaller threshold makes more nodes.
    """


class EdgesConfig(Section):
    """Noise of odometry edges, and how a loop closure enters the map."""

    hanging: Literal["chain", "ratslam"] = "chain"
    """How a loop closure enters the graph. `chain` keeps consecutive nodes joined and adds a loop edge; `ratslam` joins the
    next node to the matched one, as OpenRatSLAM does (a baseline).

    Watch: with `ratslam` one false match breaks the chain of nodes for good.
    """
    gate: Literal["map", "odometry", "cells"] = "map"
    """Poses used to find older nodes close enough for a loop closure: those of the primary back-end (`map`), of the path
    integrator (`odometry`), or those that its cells showed at each node (`cells`), which loops re-anchor.

    Watch: with `odometry` and `cells` the graph does not depend on a back-end; with `odometry`, and with `cells` where
    `neural.reanchor_weight` is 0, true loops are missed after a long drive.
    """
    drop_contradicted: bool = True
    """Drop an odometry edge if a good registration of the same two nodes contradicts it.

    Watch: if wheel odometry has drop-outs, a kept edge bends the map.
    """
    translation_floor_m: float = Field(default=0.005, ge=1e-6, le=100)
    """Standard deviation of an odometry edge's translation without travel, m."""
    rotation_floor_deg: float = Field(default=0.2, ge=1e-6, le=180)
    """Standard deviation of an odometry edge's heading without travel, degrees."""
    translation_per_sqrt_m: float = Field(default=0.02, ge=0, le=100)
    """Growth of the translation's standard deviation, m per sqrt(m) of travel.

    Watch: too small, and the edge outweighs a better registration; too large, and a false loop bends the chain.
    """
    rotation_deg_per_sqrt_m: float = Field(default=0.6, ge=0, le=180)
    """Growth of the heading's standard deviation, degrees per sqrt(m) of travel.

    Watch: heading is the largest error of wheel odometry; the gate of loop closures grows with this value.
    """
    rotation_per_turn: float = Field(default=0.02, ge=0, le=10)
    """Growth of the heading's standard deviation, radians per sqrt(radian) turned."""


class CalibrationConfig(Section):
    """Online calibration of odometry from the map as it grows. Every change of the gains is logged and stored in the map."""

    online: bool = False
    """Change the path integrator's gains while driving, when the estimate differs from them by more than three sigma.

    Watch: existing edges keep the gains with which they were made.
    """
