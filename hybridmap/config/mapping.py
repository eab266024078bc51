"""Settings of the map: the cells, when a node is made, how sure its edges are, and the gains of the odometry."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from hybridmap.config.section import Section


class PlaceConfig(Section):
    """Grid -> place learning and the place attractor."""

    attractor_side: int = Field(default=32, ge=8, le=256)
    """Cells along a side of the place attractor; the place code has side * side entries.

    Watch: every step costs in proportion to side * side, and every node stores as many numbers."""
    attractor_cell_m: float = Field(default=0.16, ge=0.01, le=10)
    """Metres a cell of the place attractor.

    Watch: the sheet repeats after side * cell metres; the place code tells places apart that are some three cells apart."""
    learning_rate: float = Field(default=0.0005, ge=0, le=1)
    """eta of the Hebbian rule, per learning step.

    Watch: fields drift towards where the robot is most often."""
    attractor_input: float = Field(default=0.0, ge=0, lt=1)
    """Share of the place cells' input in the attractor's activity at each learning step.

    Watch: with 0 the attractor is moved by self-motion alone."""


class NeuralConfig(Section):
    """The path integrator: head direction -> band -> grid -> place -> place attractor."""

    head_direction_cells: int = Field(default=360, ge=8, le=100_000)
    """m, cells of the head-direction ring.

    Watch: the heading is exact with any number; more cells only make noise average out."""
    modules: int = Field(default=8, ge=3, le=32)
    """M, grid modules; their spacings are geometric between the two limits.

    Watch: fewer make the code of positions repeat sooner; the cost of a step is in proportion."""
    sheet_side: int = Field(default=32, ge=12, le=128, multiple_of=4)
    """Cells along a side of a grid sheet.

    Watch: the cost of a step is in proportion to side * side."""
    spacing_min_m: float = Field(default=0.12, ge=0.02, le=100)
    """Grid spacing of the finest module, m.

    Watch: a step of the odometry must be well below half of it."""
    spacing_max_m: float = Field(default=0.52, ge=0.02, le=100)
    """Grid spacing of the coarsest module, m.

    Watch: place fields must be narrower than a quarter of it."""
    metric: Literal["hexagonal", "square"] = "hexagonal"
    """Metric of the sheets; `square` has bands at 0 and 90 degrees and fires on a square lattice (for comparison)."""
    rectifier: Literal["relu", "softplus"] = "relu"
    """f of the grid sheets: `relu` is the paper's, `softplus` the accurate one.

    Watch: `softplus` takes more time a step."""
    kernel: Literal["two-amplitudes", "printed"] = "two-amplitudes"
    """Recurrent weights: a difference of two Gaussians with an amplitude each, or with the printed single one.

    Watch: the printed one is unstable at one step a time constant; it is refused with the name of what happens."""
    band_drive: float = Field(default=0.1, ge=0, le=1)
    """Gain of the band stripes' excitatory input to the sheets; the uniform input is 1.

    Watch: 0 leaves only the shift, and a slow robot's motion is then lost with `relu`."""
    neuron_noise: float = Field(default=0.0, ge=0, le=0.5)
    """Standard deviation of the noise that multiplies the rate of every cell that a step updates; 0.05 is 5 %.

    Watch: the pose wanders off by what the noise leaves; 5 % cost about 0.3 m in 40 m."""
    gain: float = Field(default=1.0, gt=0, le=10)
    """k_m, metres of path integration a metre of odometry.

    Watch: `hybridmap calibrate` finds this and the next two."""
    turn_gain: float = Field(default=1.0, gt=0, le=10)
    """k_w, radians of path integration a radian of odometry.

    Watch: an error of 1 % is 3.6 degrees a full turn."""
    heading_bias_rad_m: float = Field(default=0.0, ge=-1, le=1)
    """Radians added to the heading for each metre forward.

    Watch: of the three gains it matters most on a long way."""
    reanchor_weight: float = Field(default=0.0, ge=0, le=1)
    """How far a loop closure pulls the cells to the activity stored at the matched node, moved by the measured relative pose.

    Watch: 1 puts it back hard, 0 leaves the cells alone; after a false closure they are at a wrong place. The pose in
    `odom` stays continuous either way."""
    place: PlaceConfig = PlaceConfig()
    """Grid -> place learning and the place attractor."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.spacing_min_m > self.spacing_max_m:
            raise ValueError("spacing_min_m must not exceed spacing_max_m")
        return self


class NodesConfig(Section):
    """Novelty: a node is made when the rule says so."""

    rule: Literal["travel", "novelty"] = "travel"
    """`travel`: every so many metres or degrees; `novelty`: the paper's, by place code and view template.

    Watch: under `novelty` a known place gives no node, and so no closure."""
    distance_m: float = Field(default=0.25, gt=0)
    """`travel`: metres since the last node.

    Watch: the cost of a drive is in proportion to its nodes; with far ones consecutive views share too little."""
    angle_deg: float = Field(default=15.0, gt=0, le=180)
    """`travel`: degrees turned since the last node.

    Watch: keep it well below a camera's field of view."""
    place_threshold: float = Field(default=0.4, gt=0, le=1)
    """`novelty`: S_th, the least distance (1 - cosine) of the place code to that of every node.

    Watch: a smaller one makes more nodes."""


class EdgesConfig(Section):
    """Odometry edges, and how a closure enters the map."""

    hanging: Literal["chain", "ratslam"] = "chain"
    """`chain` keeps consecutive nodes joined and adds a loop edge; `ratslam` hangs the next node on the matched one, as
    OpenRatSLAM does (a baseline).

    Watch: with `ratslam` one false match breaks the chain for good."""
    gate: Literal["map", "odometry"] = "map"
    """Whose poses gate closures: the primary back-end's, or the integrator's alone.

    Watch: with `odometry` the graph owes nothing to a back-end, and long drives drift out of the gate."""
    drop_contradicted: bool = True
    """Drop an odometry edge that a good registration of the same two nodes contradicts.

    Watch: where wheels drop out, the edge that is kept bends the map."""
    translation_floor_m: float = Field(default=0.005, gt=0)
    """Standard deviation of an odometry edge at no travel, m."""
    rotation_floor_deg: float = Field(default=0.2, gt=0)
    """Standard deviation of an odometry edge's heading at no travel, degrees."""
    translation_per_sqrt_m: float = Field(default=0.02, ge=0)
    """Growth of the translation's standard deviation, m per sqrt(m) of travel.

    Watch: too small, and the edge holds a better registration back; too large, and a false loop bends it."""
    rotation_deg_per_sqrt_m: float = Field(default=0.6, ge=0)
    """Growth of the heading's standard deviation, degrees per sqrt(m) of travel.

    Watch: wheels err in heading most; the gate of loop closures grows with it."""
    rotation_per_turn: float = Field(default=0.02, ge=0)
    """Growth of the heading's standard deviation, radians per sqrt(radian) turned."""


class CalibrationConfig(Section):
    """Odometry gains estimated from the map as it grows; every change is logged, and kept in the map file."""

    online: bool = False
    """Change the path integrator's gains while driving, where the estimate differs from those in use by three sigma.

    Watch: edges that are in the map stay as they were measured."""
