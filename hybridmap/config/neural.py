"""Settings of the spatial cells."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from hybridmap.config.section import Section


class PlaceConfig(Section):
    """Grid -> place learning and the place attractor."""

    attractor_side: int = Field(default=32, ge=8, le=256)
    """Cells along a side of the place attractor; the place code has side * side entries."""
    attractor_cell_m: float = Field(default=0.16, ge=0.01, le=10)
    """Metres a cell of the place attractor; the sheet wraps after side * cell metres."""
    attractor_width_cells: float = Field(default=1.4, ge=1.2, le=6.0)
    """Standard deviation of the attractor's bump, cells."""
    grid_inputs_side: int = Field(default=4, ge=3, le=32)
    """Grid cells along a side of each sheet that project to place cells; must divide the sheet's side."""
    learning_rate: float = Field(default=0.0005, ge=0, le=1)
    """eta of the Hebbian rule, per learning step."""
    recruit_threshold: float = Field(default=0.3, gt=0, lt=1)
    """A cell is recruited where no other responds above this share of its peak."""
    inhibition: float = Field(default=0.6, ge=0, lt=1)
    """C_inh_p, as a share of a field's peak drive; larger means narrower fields."""
    theta_hz: float = Field(default=7.5, gt=0, le=1000)
    """Learning steps a second of motion: the theta rhythm."""
    max_cells: int = Field(default=32768, ge=1, le=262144)
    """No more place cells than this are recruited; the log says when it is reached."""
    attractor_input: float = Field(default=0.0, ge=0, lt=1)
    """Share of the place cells' input in the attractor's activity at each learning step; 0: the attractor is moved by
    self-motion alone."""


class NeuralConfig(Section):
    """The path integrator: head direction -> band -> grid -> place -> place attractor."""

    dtype: Literal["float32", "float64"] = "float64"
    """Precision of every population."""
    head_direction_cells: int = Field(default=360, ge=8, le=100_000)
    """m, cells of the head-direction ring."""
    modules: int = Field(default=8, ge=3, le=32)
    """M, grid modules; their spacings are geometric between the two limits."""
    sheet_side: int = Field(default=32, ge=12, le=128)
    """Cells along a side of a grid sheet."""
    spacing_min_m: float = Field(default=0.12, ge=0.02, le=100)
    """Grid spacing of the finest module, m."""
    spacing_max_m: float = Field(default=0.52, ge=0.02, le=100)
    """Grid spacing of the coarsest module, m."""
    metric: Literal["hexagonal", "square"] = "hexagonal"
    """Metric of the sheets; `square` has bands at 0 and 90 degrees and fires on a square lattice (for comparison)."""
    orientation_deg: float = Field(default=7.0, ge=-180, le=180)
    """Orientation of the finest module's first band, degrees."""
    orientation_step_deg: float = Field(default=7.5, ge=-60, le=60)
    """Rotation of each module against the one before it, degrees."""
    rectifier: Literal["relu", "softplus"] = "relu"
    """f of the grid sheets: `relu` is the paper's, `softplus` the accurate one."""
    softplus_sharpness: float = Field(default=2.0, gt=0, le=20)
    """beta of softplus, log(1 + exp(beta x)) / beta."""
    fourier_modes: int = Field(default=4, ge=2, le=15)
    """K, the Fourier modes along each axis of a sheet that its recurrent weights carry."""
    kernel: Literal["two-amplitudes", "printed"] = "two-amplitudes"
    """Recurrent weights: a difference of two Gaussians with an amplitude each, or with the printed single one, which is
    unstable at one step a time constant and is refused with the name of what happens."""
    kernel_gain_first: float = Field(default=1.4, gt=1, le=100)
    """Fourier gain of the recurrent weights at the first hexagonal mode."""
    kernel_gain_zero: float = Field(default=-1.0, ge=-100, le=0)
    """Fourier gain of the recurrent weights at mode zero: net inhibition (two amplitudes only)."""
    kernel_widths: tuple[float, float] = (1.5, 0.3)
    """Widths of the excitatory and the inhibitory Gaussian's spectrum, in squared wave numbers of the first mode."""
    band_cells: int = Field(default=32, ge=16, le=4096)
    """Cells of a band ring (three rings a module)."""
    band_width: float = Field(default=0.1, gt=0.02, le=0.12)
    """Stripe width r as a share of the period; the rate is exp(-(s - l/2)^2 / (2 r^2))."""
    band_drive: float = Field(default=0.1, ge=0, le=1)
    """Gain of the band stripes' excitatory input to the sheets (the uniform input is 1); 0 leaves only the shift."""
    neuron_noise: float = Field(default=0.0, ge=0, le=0.5)
    """Standard deviation of the noise that multiplies the rate of every cell that a step updates; 0.05 is 5 %. Turning on the
    spot updates the head-direction ring alone."""
    neuron_noise_seed: int = Field(default=0, ge=0)
    """Seed of that noise, where no generator is handed to the integrator."""
    gain: float = Field(default=1.0, gt=0, le=10)
    """k_m, metres of path integration a metre of odometry."""
    turn_gain: float = Field(default=1.0, gt=0, le=10)
    """k_w, radians of path integration a radian of odometry."""
    heading_bias_rad_m: float = Field(default=0.0, ge=-1, le=1)
    """Radians added to the heading for each metre forward."""
    reanchor_weight: float = Field(default=0.0, ge=0, le=1)
    """At a loop closure, how far the cells are pulled to the activity stored at the matched node, moved by the measured
    relative pose: 1 puts it back hard, less is a soft pull, 0 leaves them alone. `odom` stays continuous either way."""
    decode_box_m: float = Field(default=1.0, gt=0, le=5)
    """Half side of the box around the prior in which all modules together resolve the wrap, m."""
    place: PlaceConfig = PlaceConfig()
    """Grid -> place learning and the place attractor."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.spacing_min_m > self.spacing_max_m:
            raise ValueError("spacing_min_m must not exceed spacing_max_m")
        if self.sheet_side % self.place.grid_inputs_side:
            raise ValueError("place.grid_inputs_side must divide sheet_side")
        if 2 * self.fourier_modes >= self.sheet_side:
            raise ValueError("fourier_modes must be less than half of sheet_side")
        wide, narrow = self.kernel_widths
        if not 100 >= wide >= 1.01 * narrow >= 0.01:
            raise ValueError(
                "kernel_widths: both must be from 0.01 to 100, and the excitatory spectrum the wider one, by 1 % at least"
            )
        return self
