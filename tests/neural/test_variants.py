"""The selectable variants of the cells: metric, kernel, noise, soft re-anchoring, the place cells' input."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap import geometry
from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import ConfigError
from hybridmap.neural import PathIntegrator
from hybridmap.neural.grid import GridModules, LowModes, kernel_spectrum, relu
from hybridmap.neural.place import PlaceProjection
from tests.neural.neural_drives import wander


def driven(seed, distance_m, rng=None, **settings):
    integrator = PathIntegrator(NeuralConfig.model_validate(settings), rng)
    deltas, poses = wander(seed, distance_m)
    for delta in deltas:
        integrator.step(delta, 1 / 30)
    return integrator, poses[-1]


def test_the_square_metric_integrates_as_well():
    integrator, exact = driven(3, 5.0, metric="square")
    assert integrator.module_errors(exact).max() < 0.005
    assert integrator.pose == pytest.approx(exact, abs=5e-4)


def test_the_bands_of_the_square_metric_are_orthogonal_and_the_third_is_their_sum():
    waves = PathIntegrator(NeuralConfig(metric="square")).bands.wave_vectors
    assert np.sum(waves[:, 0] * waves[:, 2], axis=1) == pytest.approx(np.zeros(8), abs=1e-9)
    assert waves[:, 1] == pytest.approx(waves[:, 0] + waves[:, 2])


def test_the_printed_kernel_has_no_local_excitation_and_inhibits_far_too_much():
    squared = LowModes(32, 15).squared_wave_number()
    gains = kernel_spectrum(squared, kernel="printed")
    assert gains[squared == 1] == pytest.approx(1.4)
    assert gains[squared == 0] < -10.0
    in_space = LowModes(32, 15).inverse(gains[:, None].astype(complex))[:, 0]
    assert in_space[0, 0] < 0.0
    assert in_space.sum() == pytest.approx(gains[squared == 0][0])


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ({"kernel": "printed"}, "period-two oscillation"),
        ({"kernel": "printed", "rectifier": "softplus"}, "period-two oscillation"),
    ],
)
def test_an_unstable_kernel_is_refused_with_what_happens(setting, named):
    with pytest.raises(ConfigError, match=named):
        PathIntegrator(NeuralConfig.model_validate(setting))


@pytest.mark.parametrize(
    ("gain_first", "widths", "named"), [(3.0, (1.5, 0.3), "grows without bound"), (1.4, (3.0, 1.0), "do not settle")]
)
def test_gains_of_no_stationary_pattern_are_refused(gain_first, widths, named):
    gains = kernel_spectrum(LowModes(32, 4).squared_wave_number(), gain_first, -1.0, widths)
    with pytest.raises(ConfigError, match=named):
        GridModules(8, 32, 4, gains, relu, 0.1)


def test_noise_comes_from_the_generator_and_costs_accuracy():
    first, exact = driven(4, 4.0, np.random.default_rng(1), neuron_noise=0.05)
    again, _ = driven(4, 4.0, np.random.default_rng(1), neuron_noise=0.05)
    other, _ = driven(4, 4.0, np.random.default_rng(2), neuron_noise=0.05)
    assert np.array_equal(first.grid.activity, again.grid.activity)
    assert not np.array_equal(first.grid.activity, other.grid.activity)
    assert 1e-4 < abs(geometry.wrap_angle(first.pose[2] - exact[2])) < 0.3


def test_noise_reaches_every_population_that_carries_the_state():
    quiet, noisy = PathIntegrator(NeuralConfig()), PathIntegrator(NeuralConfig(neuron_noise=0.05))
    for integrator in (quiet, noisy):
        integrator.step((0.02, 0.01, 0.05), 0.1)
    for name in ("head_direction", "bands", "grid", "attractor"):
        still, stirred = (getattr(integrator, name).activity for integrator in (quiet, noisy))
        assert float(np.abs(still - stirred).max()) > 1e-4 * float(still.max()), name


def test_noise_while_turning_on_the_spot_is_the_ring_s_alone():
    """Cells that nothing updates have nothing to be noisy in; else the noise would multiply up without bound."""
    integrator = PathIntegrator(NeuralConfig(neuron_noise=0.1))
    before = {name: getattr(integrator, name).activity.copy() for name in ("bands", "grid", "attractor")}
    for _ in range(300):
        integrator.step((0.0, 0.0, 0.02), 0.1)
    assert all(np.array_equal(getattr(integrator, name).activity, activity) for name, activity in before.items())
    assert abs(integrator.head_direction.heading_rad - math.remainder(6.0, 2.0 * math.pi)) > 1e-6


def test_noise_leaves_a_robot_that_stands_alone():
    integrator = PathIntegrator(NeuralConfig(neuron_noise=0.1))
    before = integrator.pose
    integrator.step(np.zeros(3), 0.1)
    assert np.array_equal(integrator.pose, before)


@settings(max_examples=12, deadline=None)
@given(weight=st.floats(0.0, 1.0), x=st.floats(-0.8, 0.8), y=st.floats(-0.8, 0.8), yaw=st.floats(-2.0, 2.0))
def test_a_soft_pull_goes_that_share_of_the_way(weight, x, y, yaw):
    integrator = PathIntegrator(NeuralConfig(rectifier="softplus"))
    stored, start = integrator.snapshot(), integrator.pose
    integrator.step((x, y, yaw), 0.1)
    gone = integrator.pose - start
    integrator.restore(stored, weight)
    assert integrator.pose - start == pytest.approx((1.0 - weight) * gone, abs=1e-4)
    assert integrator.attractor.unwrapped_m(integrator.pose[:2]) == pytest.approx(integrator.pose[:2], abs=1e-3)
    assert integrator.decode().agreed


@pytest.mark.parametrize("weight", [-0.1, 1.1, float("nan")])
def test_a_weight_that_is_no_share_is_refused(weight):
    integrator = PathIntegrator(NeuralConfig())
    with pytest.raises(ConfigError, match="weight from 0 to 1"):
        integrator.restore(integrator.snapshot(), weight)


def test_a_projection_learns_where_the_bump_was():
    projection, bumps = PlaceProjection(16), np.eye(16, dtype=np.float32)
    for _ in range(3):
        projection.learn(np.array([1.0, 0.0], dtype=np.float32), bumps[3])
        projection.learn(np.array([0.0, 0.5], dtype=np.float32), bumps[9])
    shown = projection.onto(np.array([0.2, 1.0], dtype=np.float32))
    assert shown == pytest.approx(0.2 * bumps[3] + bumps[9])


def test_place_input_pulls_a_displaced_bump_back():
    with_input, alone = (PathIntegrator(NeuralConfig.model_validate({"place": {"attractor_input": s}})) for s in (0.3, 0.0))
    for integrator in (with_input, alone):
        for _ in range(2):
            for way in (0.02, -0.02):
                for _ in range(60):
                    integrator.step((way, 0.0, 0.0), 1 / 30)
        integrator.attractor.step(np.array([0.0, 0.3]))
        for way in (0.02, -0.02):
            for _ in range(60):
                integrator.step((way, 0.0, 0.0), 1 / 30)
    off = [abs(i.attractor.unwrapped_m(np.zeros(2))[1]) for i in (with_input, alone)]
    assert off[1] == pytest.approx(0.3, abs=1e-3)
    assert off[0] < 0.5 * off[1]


def test_a_ring_is_decoded_anew_when_its_activity_is_replaced_and_cannot_be_written_into():
    bands = PathIntegrator(NeuralConfig()).bands
    before = bands.phases()
    with pytest.raises(ValueError, match="read-only"):
        bands.activity[0, 0, 0] = 1.0
    bands.activity = np.roll(bands.activity, 4, axis=2)
    assert (bands.phases() - before + 0.5) % 1.0 - 0.5 == pytest.approx(np.full((8, 3), 0.125))
