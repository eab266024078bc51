"""The path integrator: from self-motion to pose and place code, by network activity alone."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.geometry import Array, compose, inverse
from hybridmap.neural.composition import LARGEST_STEP_M, Integrator, Snapshot, checked_step
from hybridmap.neural.grid import (
    FOURIER_MODES,
    Decoded,
    GridModules,
    LowModes,
    PhaseDecoder,
    kernel_spectrum,
    relu,
    shift_sheets,
    softplus,
)
from hybridmap.neural.place import PlaceAttractor, PlaceCells, PlaceProjection
from hybridmap.neural.rings import BandRings, HeadDirectionRing
from hybridmap.odometry_model import Gains, step_of

log = logging.getLogger(__name__)

ORIENTATION_DEG, ORIENTATION_STEP_DEG = 7.0, 7.5
"""Orientation of the finest module's first band, and the rotation of each module against the one before it, degrees: eight
modules share the 60 degrees after which a hexagonal lattice repeats, and none lies along a wall."""
THETA_HZ = 7.5
"""Learning steps a second of motion: the theta rhythm of a moving rat (6-10 Hz)."""
NEURON_NOISE_SEED = 0
"""Seed of `neural.neuron_noise` where no generator is handed in."""
_PART_OF_WRAP = 0.1
_WRAPS = np.array(sorted(((x, y) for x in range(-8, 9) for y in range(-8, 9)), key=lambda w: (w[0] ** 2 + w[1] ** 2, w)), float)


class PathIntegrator:
    """Path integrator made of cells: head direction -> band -> grid -> place -> place attractor.

    The pose is decoded from the head-direction ring and the phases of all grid sheets together; no other state integrates the
    position. The phases repeat, so decoding needs a start: the last decoded position and the place attractor's bump. If
    the modules do not agree there, the box around it is searched, and then the attractor's other repetitions (8 each way). The
    start selects a repetition and has no other effect.

    Attributes:
        gains: calibration of the next steps; may be changed at any time.
        spacings_m: (M,) grid spacing of each module, m.
        head_direction, bands, grid, place, attractor: the populations of cells.
    """

    def __init__(
        self,
        config: NeuralConfig,
        rng: np.random.Generator | None = None,
        dtype: DTypeLike = np.float64,
        heading_concentration: float = 0.0,
    ) -> None:
        """Make every population of cells and let it settle at the origin.

        Args:
            config: settings of the cells.
            rng: random generator of the neuron noise; by default one is made from `NEURON_NOISE_SEED`.
            dtype: floating-point type of every population.
            heading_concentration: of the head-direction cells' von Mises tuning; 0: the paper's cosine. The pose is the same.

        Raises:
            ConfigError: there are no modules, the grid sheets do not settle with this kernel, or the head-direction cells are
                too few.
        """
        if config.modules == 0:
            raise ConfigError("neural.modules: expected 3 or more, found 0: there are no cells to look at")
        self.config = config
        self.gains = Gains.of(config)
        self.spacings_m = _spacings_m(config)
        self.head_direction = HeadDirectionRing(config.head_direction_cells, dtype, heading_concentration)
        self.bands = band_rings(config, dtype)
        self.grid = _grid(config, dtype)
        place = config.place
        self.place = PlaceCells(place, config.sheet_side, self.spacings_m)
        self.attractor = PlaceAttractor(place.attractor_side, place.attractor_cell_m, dtype=dtype)
        self._projection = PlaceProjection(place.attractor_side**2)
        self._rng = np.random.default_rng(NEURON_NOISE_SEED) if rng is None else rng
        self._decoder = PhaseDecoder(self.bands.wave_vectors)
        self._last_decoded_m: Array = np.zeros(2)
        self._since_theta_s = 0.0
        self._since_decoding_m = 0.0
        self._read_out_every_m = _PART_OF_WRAP * self.attractor.extent_m
        self._theta_period_s = 1.0 / THETA_HZ - 1e-9
        self._warned = False
        self.place.learn(self.grid.activity, self._last_decoded_m)

    def step(self, delta_robot: ArrayLike, dt_s: float) -> None:
        """Integrate one displacement. One of zero changes nothing; a turn on the spot moves the head-direction ring alone.

        Args:
            delta_robot: (3,) pose of the robot now in the frame of the robot at the last step, m and rad (`geometry.between`
                of two odometry poses); the gains calibrate it (`odometry_model`).
            dt_s: seconds since the last step; it sets the theta rhythm. The sheets' time constant is one step, so their
                dynamics do not need it.

        Raises:
            StreamError: the displacement or the time is not finite, or it is more than a kilometre.
        """
        dx, dy, dyaw = checked_step(delta_robot, dt_s)
        if dx == 0.0 and dy == 0.0 and dyaw == 0.0:
            return
        forward, left, turn = step_of(dx, dy, dyaw, self.gains)
        c, s = self.head_direction.turn(turn)
        translates = dx != 0.0 or dy != 0.0
        if self.config.neuron_noise > 0.0:
            self._disturb(translates)
        if translates:
            self._translate(c * forward - s * left, s * forward + c * left, dt_s)

    @property
    def pose(self) -> Array:
        """Pose (3,) decoded from activity, m and rad, in the frame in which the integrator started."""
        return np.array([*self.decode().position_m, self.head_direction.heading_rad])

    @property
    def place_code(self) -> NDArray[np.float32]:
        """Rates (P,) of the P place-attractor cells, of unit length; two places differ by 1 - the dot product of their codes.

        The code is a function of the present activity alone: the same place gives the same code whenever it is visited.
        """
        return self.attractor.code(self.attractor.unwrapped_m(self._last_decoded_m))

    def decode(self) -> Decoded:
        """Decode the position from all sheets together, with how well the modules agree.

        The next decoding starts from the result. The first time the modules do not agree, a warning is logged.
        """
        decoded = self._decoder.decode(self.grid.band_phases(), self._last_decoded_m, self._attractor_starts)
        if not decoded.agreed and not self._warned:
            log.warning(
                "the grid modules agree on no position (misfit %.2f cycles); the likeliest is used", decoded.misfit_cycles
            )
            self._warned = True
        self._last_decoded_m = decoded.position_m
        self._since_decoding_m = 0.0
        return decoded

    def module_errors(self, position_m: ArrayLike) -> Array:
        """Distance (M,) of each module's position, in its nearest repetition, from a true one (2,), m; in its spacings."""
        waves = self.bands.wave_vectors[:, [0, 2], :]
        offset = self.grid.phases() - waves @ np.asarray(position_m, dtype=np.float64)[:2]
        offset -= np.round(offset)
        metres = np.linalg.solve(waves, offset[..., None])[..., 0]
        return np.asarray(np.linalg.norm(metres, axis=1) / self.spacings_m)

    def snapshot(self) -> Snapshot:
        """The state that a node stores, so that `restore` returns the network to it (some 8 kB).

        Keys: `heading` (m,), `band_phases` (M, 3) and `grid_phases` (M, 2), cycles, `attractor` (N, N), and `near_m` (2,): the
        decoded position, which selects the repetition of the code.
        """
        near = self.decode().position_m
        return {
            "heading": self.head_direction.activity.copy(),
            "band_phases": self.bands.phases(),
            "grid_phases": self.grid.phases(),
            "attractor": self.attractor.activity.astype(np.float32),
            "near_m": near.copy(),
        }

    def restore(self, snapshot: Snapshot, weight: float = 1.0, delta_snapshot_robot: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Set the network to a stored activity, wholly or in part: re-anchoring (paper eq. 16, the visual recalibration).

        Args:
            snapshot: what `snapshot` returned.
            weight: 1 sets the activity exactly; less moves the ring, each band, each sheet and the attractor's bump by that
                share of the way to it, repetitions being resolved by both decoded positions.
            delta_snapshot_robot: (3,) pose of the robot seen from where the snapshot was taken, m and rad: the stored
                activity is moved by it.

        Raises:
            ConfigError: the weight is not in 0..1.
            StreamError: the relative pose is not finite, has not the shape (3,), or is more than a kilometre.
        """
        if not 0.0 <= weight <= 1.0:
            raise ConfigError(f"re-anchoring: expected a weight from 0 to 1, found {weight}")
        delta = np.asarray(delta_snapshot_robot, dtype=np.float64)
        if delta.shape != (3,) or not math.hypot(*delta[:2]) <= LARGEST_STEP_M or not math.isfinite(delta[2]):
            raise StreamError(f"re-anchoring: expected a pose (x, y, yaw) within {LARGEST_STEP_M:g} m, found {delta.tolist()}")
        here = self._moved(snapshot, delta) if delta.any() else snapshot
        moved_m = np.asarray(here["near_m"] - snapshot["near_m"], dtype=np.float64)
        if weight < 1.0:
            self._pull(here, moved_m, weight)
            return
        self._put_back(here)
        if delta.any():
            self.attractor.step(moved_m)

    def _put_back(self, snapshot: Snapshot) -> None:
        dtype = self.grid.activity.dtype
        self.head_direction.activity = np.asarray(snapshot["heading"], dtype=dtype).copy()
        self.bands.activity = self.bands.rates_at(np.asarray(snapshot["band_phases"], dtype=np.float64))
        target = np.asarray(snapshot["grid_phases"], dtype=np.float64)
        self.grid.activity = shift_sheets(self.grid.activity, target - self.grid.phases())
        self.attractor.activity = np.asarray(snapshot["attractor"], dtype=dtype).copy()
        self._last_decoded_m = np.asarray(snapshot["near_m"], dtype=np.float64).copy()

    def _moved(self, snapshot: Snapshot, delta: Array) -> Snapshot:
        """The snapshot as if it had been taken at a pose (3,) seen from where it was; all but the place attractor."""
        ring = self.head_direction
        heading = ring.heading_of(snapshot["heading"])
        way = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]) @ delta[:2]
        shift = self.bands.wave_vectors @ way
        return {
            "heading": ring.rates_at(heading + delta[2]),
            "band_phases": np.asarray(snapshot["band_phases"], dtype=np.float64) + shift,
            "grid_phases": np.asarray(snapshot["grid_phases"], dtype=np.float64) + shift[:, [0, 2]],
            "attractor": snapshot["attractor"],
            "near_m": np.asarray(snapshot["near_m"], dtype=np.float64) + way,
        }

    def _pull(self, snapshot: Snapshot, moved_m: Array, weight: float) -> None:
        """Go a share of the way to a snapshot, whose attractor still stands `moved_m` (2,) behind the rest of it."""
        here = self.decode().position_m
        way = np.asarray(snapshot["near_m"], dtype=np.float64) - here
        expected = self.bands.wave_vectors @ way
        ring = self.head_direction
        turn = ring.heading_of(snapshot["heading"]) - ring.heading_rad
        ring.turn(weight * math.remainder(turn, 2.0 * math.pi))
        bands, sheets = self.bands.phases(), self.grid.phases()
        band_way = _unwrapped(np.asarray(snapshot["band_phases"], dtype=np.float64) - bands, expected)
        sheet_way = _unwrapped(np.asarray(snapshot["grid_phases"], dtype=np.float64) - sheets, expected[:, [0, 2]])
        self.bands.activity = self.bands.rates_at(bands + weight * band_way)
        self.grid.activity = shift_sheets(self.grid.activity, weight * sheet_way)
        attractor = self.attractor
        bump_way = attractor.position_of(np.asarray(snapshot["attractor"])) + moved_m - attractor.position_m()
        bump_way -= attractor.extent_m * np.round((bump_way - way) / attractor.extent_m)
        attractor.step(weight * bump_way)
        self._last_decoded_m = here + weight * way

    def _attractor_starts(self) -> Array:
        """Where the attractor's bump may be, (S, 2), m: nearest to the last decoded position first."""
        return self.attractor.unwrapped_m(self._last_decoded_m) + _WRAPS * self.attractor.extent_m

    def _translate(self, x_m: float, y_m: float, dt_s: float) -> None:
        """Move the network; a jump is taken in parts, so that the read-out sees each turn of the attractor's wrap."""
        way_m, most_m = math.hypot(x_m, y_m), self._read_out_every_m
        parts = max(math.ceil(way_m / most_m), 1)
        part = np.array((x_m / parts, y_m / parts))
        for _ in range(parts):
            motion = self.bands.step(part)
            self.grid.step(motion.advance, motion.phasors)
            self.attractor.step(part)
            self._since_decoding_m += way_m / parts
            if self._since_decoding_m >= most_m:
                self.decode()
        self._since_theta_s += dt_s
        if self._since_theta_s >= self._theta_period_s:
            self._since_theta_s = 0.0
            self._learn()

    def _learn(self) -> None:
        """Let the place cells learn, and the attractor receive their input where it is configured."""
        share = self.config.place.attractor_input
        cells, rates = self.place.learn(self.grid.activity, self.attractor.unwrapped_m(self._last_decoded_m))
        if share > 0.0:
            self.attractor.receive(self._projection.onto(rates, cells), share)
            self._projection.learn(rates, self.attractor.activity.ravel(), cells)

    def _disturb(self, translates: bool) -> None:
        """Multiply the rates by 1 + noise: of the ring, which turns, and of the cells that this step updates."""
        noise, rng = self.config.neuron_noise, self._rng
        moved = (self.bands, self.grid, self.attractor) if translates else ()
        for population in (self.head_direction, *moved):
            rates = population.activity
            population.activity = rates * (1.0 + noise * rng.standard_normal(rates.shape)).astype(rates.dtype)


def _unwrapped(difference: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """The phase difference, cycles, in the repetition that is nearest to the expected one."""
    return np.asarray(difference - np.round(difference - expected))


def band_rings(config: NeuralConfig, dtype: DTypeLike = np.float64) -> BandRings:
    """The rings of band cells of all modules, finest first, at phase zero."""
    turned = np.radians(ORIENTATION_DEG + ORIENTATION_STEP_DEG * np.arange(config.modules))
    return BandRings(_spacings_m(config), turned, dtype=dtype, metric=config.metric)


def _spacings_m(config: NeuralConfig) -> NDArray[np.float64]:
    return np.geomspace(config.spacing_min_m, config.spacing_max_m, config.modules)


def _grid(config: NeuralConfig, dtype: DTypeLike) -> GridModules:
    squared = LowModes(config.sheet_side, FOURIER_MODES).squared_wave_number(config.metric)
    gains = kernel_spectrum(squared, kernel=config.kernel)
    return GridModules(
        config.modules,
        config.sheet_side,
        FOURIER_MODES,
        gains,
        relu if config.rectifier == "relu" else softplus(),
        config.band_drive,
        dtype,
        config.metric,
    )


class Reanchoring:
    """Re-anchoring: sets the path integrator to a matched node's activity (paper eq. 16), and keeps `odom` continuous.

    The cells jump to the matched node's activity, so that a visited place has its old place code again. The jump is subtracted
    from the pose in `odom` (REP-105), so that odometry edges do not contain it.

    Attributes:
        weight: how far the cells are moved, 0..1; 0 leaves them alone.
        put_back_nodes: numbers of the nodes whose activity was stored anew by `put_back`, in that order.
    """

    def __init__(self, integrator: Integrator, weight: float) -> None:
        self.weight = weight
        self.put_back_nodes: list[int] = []
        self._integrator = integrator
        self._pose_odom_cells: Array | None = None
        self._activity_at_node: dict[int, Snapshot] = {}
        self._poses_of_nodes: list[Array] = []

    @property
    def poses_of_nodes(self) -> Array:
        """(N, 3) poses that the cells showed at each node, m and rad: in one frame, as recalibration puts them back there."""
        return np.array(self._poses_of_nodes).reshape(-1, 3)

    @property
    def pose_odom_robot(self) -> Array:
        """Pose (3,) decoded from the cells, m and rad, in `odom`, where the drive begins."""
        pose = self._integrator.pose
        return pose if self._pose_odom_cells is None else compose(self._pose_odom_cells, pose)

    def remember(self, node: int) -> None:
        """Store the cells' activity as that of a node, the newest or an earlier one; with weight 0 all others are forgotten."""
        if self.weight == 0.0:
            self._activity_at_node.clear()
        self._activity_at_node[node] = self._integrator.snapshot()
        self._poses_of_nodes[node : node + 1] = [self._integrator.pose]

    def activity_at(self, node: int) -> Snapshot:
        """The stored activity of a node; with weight 0, the default, known for the newest node only.

        Raises:
            KeyError: none is stored.
        """
        return self._activity_at_node[node]

    def recalibrate(self, node: int, delta_node_robot: Array) -> None:
        """Move the cells by the share `weight` towards the activity of a matched node; with 0 nothing changes.

        Args:
            node: the matched node.
            delta_node_robot: (3,) pose of the robot in the frame of the node, m and rad; the activity is moved by it.

        Raises:
            KeyError: the weight is not 0, and no activity of the node is stored.
        """
        if self.weight == 0.0:
            return
        before = self.pose_odom_robot
        self._integrator.restore(self._activity_at_node[node], self.weight, delta_node_robot)
        self._pose_odom_cells = compose(before, inverse(self._integrator.pose))

    def put_back(self, deltas_robot_node: Mapping[int, Array]) -> None:
        """Store anew the activity of nodes that were made while the robot was lost, now that a closure said where it is.

        The cells show each of them from where the robot is, and then the robot again. With weight 0 nothing changes.

        Args:
            deltas_robot_node: number of a node -> its pose (3,) in the frame of the robot, m and rad.
        """
        if self.weight == 0.0 or not deltas_robot_node:
            return
        here = self._integrator.snapshot()
        for node, delta in deltas_robot_node.items():
            self._integrator.restore(here, 1.0, delta)
            self.remember(node)
        self._integrator.restore(here)
        self.put_back_nodes += deltas_robot_node
