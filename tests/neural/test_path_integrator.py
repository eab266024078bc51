import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap import geometry
from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import StreamError
from hybridmap.neural import PathIntegrator
from hybridmap.neural.grid import shift_sheets
from hybridmap.neural.rings import BandMotion
from hybridmap.verification.shadow import overwrite
from tests.neural.neural_drives import arc, wander


def drive(config, deltas, poses, dtype=np.float64):
    """Largest error of a module (share of its spacing), of the position (m) and of the heading (rad)."""
    integrator = PathIntegrator(config, dtype=dtype)
    module = position = heading = 0.0
    for k, (delta, exact) in enumerate(zip(deltas, poses, strict=True)):
        integrator.step(delta, 1 / 30)
        if k % 10 == 0 or k == len(deltas) - 1:
            pose = integrator.pose
            module = max(module, float(integrator.module_errors(exact).max()))
            position = max(position, float(np.linalg.norm(pose[:2] - exact[:2])))
            heading = max(heading, abs(float(geometry.wrap_angle(pose[2] - exact[2]))))
    return module, position, heading


@pytest.mark.parametrize(
    ("settings", "dtype", "module_bar", "metres_bar"),
    [
        ({}, "float64", 0.005, 3e-4),
        ({}, "float32", 0.005, 3e-4),
        ({"rectifier": "softplus"}, "float64", 2e-4, 1e-5),
        ({"band_drive": 0.0}, "float64", 0.005, 5e-4),
    ],
    ids=["relu", "relu-float32", "softplus", "shift-only"],
)
def test_a_short_drive_matches_exact_integration(settings, dtype, module_bar, metres_bar):
    module, position, _ = drive(NeuralConfig(**settings), *wander(1, 12.0), dtype)
    assert module <= module_bar
    assert position <= metres_bar


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 7, 2026])
def test_230_m_match_exact_integration(seed):
    module, position, heading = drive(NeuralConfig(), *wander(seed, 230.0))
    assert module <= 0.005
    assert position <= 3e-4
    assert heading <= 1e-9


@pytest.mark.slow
def test_fast_sampling_matches_exact_integration():
    module, position, _ = drive(NeuralConfig(), *wander(5, 60.0, dt_s=1 / 200))
    assert module <= 0.006
    assert position <= 5e-4


def test_standing_still_changes_nothing():
    integrator = PathIntegrator(NeuralConfig())
    for delta in wander(2, 1.0)[0]:
        integrator.step(delta, 1 / 30)
    before, sheets = integrator.pose, integrator.grid.activity.copy()
    for _ in range(100_000):
        integrator.step(np.zeros(3), 0.01)
    assert np.array_equal(integrator.pose, before)
    assert np.array_equal(integrator.grid.activity, sheets)


def test_motion_far_below_the_pinning_of_the_sheets_is_not_lost():
    integrator = PathIntegrator(NeuralConfig())
    for _ in range(2000):
        integrator.step((2e-6, 0.0, 0.0), 0.01)
    assert integrator.pose == pytest.approx([0.004, 0.0, 0.0], abs=2e-4)


def test_turning_on_the_spot_leaves_the_sheets_alone():
    integrator = PathIntegrator(NeuralConfig())
    before = integrator.grid.activity.copy()
    integrator.step((0.0, 0.0, 1.0), 0.1)
    assert np.array_equal(integrator.grid.activity, before)
    assert integrator.pose == pytest.approx([0.0, 0.0, 1.0], abs=1e-5)


@settings(max_examples=12, deadline=None)
@given(
    x=st.floats(-0.6, 0.6),
    y=st.floats(-0.6, 0.6),
)
def test_overwriting_the_activity_moves_the_pose_by_exactly_that(x, y):
    integrator = PathIntegrator(NeuralConfig(rectifier="softplus"))
    integrator.step((0.4, 0.1, 0.3), 1.0)
    before = integrator.pose
    shift = integrator.bands.wave_vectors[:, [0, 2]] @ np.array([x, y])
    integrator.grid.activity = shift_sheets(integrator.grid.activity, shift)
    moved = integrator.pose - before
    assert moved == pytest.approx([x, y, 0.0], abs=1e-6 * 0.12)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_overwritten_activity_is_where_integration_goes_on(dtype):
    integrator = PathIntegrator(NeuralConfig(), dtype=dtype)
    integrator.step((0.4, 0.1, 0.0), 1.0)
    before = integrator.pose
    overwrite(integrator, "both", np.array([0.31, -0.22]))
    for _ in range(30):
        integrator.step((0.02, 0.0, 0.0), 1 / 30)
    assert integrator.pose - before == pytest.approx([0.91, -0.22, 0.0], abs=5e-4)


def test_there_is_no_position_beside_the_network():
    integrator, other = PathIntegrator(NeuralConfig()), PathIntegrator(NeuralConfig())
    for delta in wander(3, 4.0)[0]:
        integrator.step(delta, 1 / 30)
    other.head_direction.activity = integrator.head_direction.activity.copy()
    other.bands.activity = integrator.bands.activity.copy()
    other.grid.activity = integrator.grid.activity.copy()
    other.attractor.activity = integrator.attractor.activity.copy()
    assert other.pose == pytest.approx(integrator.pose, abs=1e-12)


def test_sheets_stop_when_the_bands_do(monkeypatch):
    integrator = PathIntegrator(NeuralConfig(band_drive=0.0))
    before = integrator.grid.phases()
    still = BandMotion(np.zeros((8, 3)), np.ones((8, 3), complex))
    monkeypatch.setattr(integrator.bands, "step", lambda displacement_m: still)
    integrator.step((0.05, 0.0, 0.0), 0.1)
    assert integrator.grid.phases() == pytest.approx(before, abs=1e-9)


def test_a_jump_of_many_wraps_is_followed():
    integrator = PathIntegrator(NeuralConfig())
    integrator.step((17.3, -4.1, 2.0), 10.0)
    assert integrator.pose == pytest.approx([17.3, -4.1, 2.0], abs=1e-3)


@settings(max_examples=20, deadline=None)
@given(dx=st.floats(-1.5, 1.5), dy=st.floats(-0.5, 0.5), dyaw=st.floats(-2.0, 2.0))
def test_any_increment_is_composed_exactly(dx, dy, dyaw):
    integrator = PathIntegrator(NeuralConfig(rectifier="softplus"))
    start = np.array([0.2, -0.1, 0.7])
    integrator.step(start, 0.1)
    integrator.step((dx, dy, dyaw), 0.1)
    expected = geometry.compose(start, (dx, dy, dyaw))
    assert geometry.between(expected, integrator.pose) == pytest.approx(np.zeros(3), abs=2e-5)


def test_a_displacement_that_is_not_finite_is_refused():
    integrator = PathIntegrator(NeuralConfig())
    before = integrator.pose
    with pytest.raises(StreamError, match="finite"):
        integrator.step((np.nan, 0.0, 0.0), 0.1)
    assert np.array_equal(integrator.pose, before)


@pytest.mark.parametrize("way", [5e-324, 1e-300])
def test_a_way_too_short_for_a_number_does_no_harm(way):
    integrator = PathIntegrator(NeuralConfig(gain=0.1))
    integrator.step((way, 0.0, 0.0), 0.1)
    assert integrator.pose == pytest.approx(np.zeros(3), abs=1e-4)


def test_an_absurd_jump_is_refused_with_its_size():
    with pytest.raises(StreamError, match="found 20000 m"):
        PathIntegrator(NeuralConfig()).step((2e4, 0.0, 0.0), 0.1)


def test_modules_that_disagree_are_reported(caplog):
    integrator = PathIntegrator(NeuralConfig())
    rng = np.random.default_rng(5)
    integrator.grid.activity = shift_sheets(integrator.grid.activity, rng.uniform(size=(8, 2)))
    assert not integrator.decode().agreed
    assert "agree on no position" in caplog.text


def test_gains_and_heading_bias():
    integrator = PathIntegrator(NeuralConfig(gain=1.02, turn_gain=0.98, heading_bias_rad_m=0.01))
    exact = np.zeros(3)
    for _ in range(100):
        integrator.step(arc(0.6, 0.3, 0.05), 0.05)
        exact = geometry.compose(exact, arc(1.02 * 0.6, 0.98 * 0.3 + 0.01 * 0.6, 0.05))
    assert integrator.pose == pytest.approx(exact, abs=5e-4)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 100))
def test_restore_brings_the_network_back(seed):
    integrator = PathIntegrator(NeuralConfig())
    deltas, _ = wander(seed, 3.0)
    for delta in deltas[:90]:
        integrator.step(delta, 1 / 30)
    stored, pose, code = integrator.snapshot(), integrator.pose, integrator.place_code
    for _ in range(20):
        integrator.step((0.6, 0.0, 0.3), 1.0)
    integrator.restore(stored)
    assert integrator.pose == pytest.approx(pose, abs=1e-5)
    assert integrator.place_code == pytest.approx(code, abs=1e-5)
    integrator.step((0.1, 0.0, 0.0), 0.1)
    assert integrator.pose == pytest.approx(geometry.compose(pose, (0.1, 0.0, 0.0)), abs=2e-4)


def test_a_snapshot_is_small_and_a_copy():
    integrator = PathIntegrator(NeuralConfig())
    stored = integrator.snapshot()
    heading = stored["heading"].copy()
    integrator.step((0.1, 0.0, 0.5), 0.1)
    assert np.array_equal(stored["heading"], heading)
    assert sum(value.nbytes for value in stored.values()) < 16_000


def test_the_pose_may_be_read_rarely():
    deltas, poses = wander(4, 12.0)
    integrator = PathIntegrator(NeuralConfig())
    for k, delta in enumerate(deltas):
        integrator.step(delta, 1 / 30)
        if k % 150 == 149:
            assert integrator.pose[:2] == pytest.approx(poses[k, :2], abs=5e-4)


def test_the_place_code_is_near_at_the_same_place_and_far_at_half_a_metre():
    integrator, codes = PathIntegrator(NeuralConfig()), []
    for _ in range(2):
        for yaw in (0.0, np.pi / 2, np.pi / 2, np.pi / 2):
            integrator.step((0.0, 0.0, yaw), 0.1)
            for _ in range(20):
                integrator.step((0.05, 0.0, 0.0), 0.1)
                codes.append(integrator.place_code)
        integrator.step((0.0, 0.0, np.pi / 2), 0.1)
    first, second = np.array(codes[:80]), np.array(codes[80:])
    assert (1.0 - np.sum(first * second, axis=1)).max() < 0.01
    assert 1.0 - first[0] @ first[8] > 0.5
    assert first.shape == (80, 1024)
    assert first.dtype == np.float32


def test_the_same_input_gives_the_same_bytes():
    def run():
        integrator = PathIntegrator(NeuralConfig())
        for delta in wander(9, 2.0)[0]:
            integrator.step(delta, 1 / 30)
        return integrator.pose.tobytes() + integrator.place_code.tobytes() + integrator.place.weights.tobytes()

    assert run() == run()


def test_a_bump_that_went_astray_does_not_lose_the_position():
    integrator = PathIntegrator(NeuralConfig())
    exact = np.zeros(3)
    for _ in range(100):
        integrator.attractor.step(np.array([0.05, -0.03]))
        integrator.step((0.05, 0.0, 0.01), 0.1)
        exact = geometry.compose(exact, np.array([0.05, 0.0, 0.01]))
    assert integrator.decode().agreed
    assert integrator.pose == pytest.approx(exact, abs=1e-3)
