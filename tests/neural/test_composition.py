"""Plain composition of the odometry, in the place of the cells: the same poses, without a code."""

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.geometry import between, compose
from hybridmap.neural.composition import Composition
from hybridmap.neural.path_integrator import PathIntegrator, Reanchoring

GAINS = {"gain": 1.02, "turn_gain": 0.97, "heading_bias_rad_m": 0.01}


def steps(count=60):
    rng = np.random.default_rng(4)
    return np.column_stack([rng.uniform(-0.02, 0.06, count), rng.uniform(-0.01, 0.01, count), rng.uniform(-0.1, 0.1, count)])


@pytest.mark.parametrize("gains", [{}, GAINS])
def test_it_gives_the_pose_that_the_cells_give(gains):
    cells, numbers = PathIntegrator(NeuralConfig(**gains)), Composition(NeuralConfig(modules=0, **gains))
    for step in steps():
        cells.step(step, 0.05)
        numbers.step(step, 0.05)
    assert numbers.pose == pytest.approx(cells.pose, abs=2e-4)
    assert numbers.place_code.shape == (0,)


@pytest.mark.parametrize("weight", [1.0, 0.5])
def test_a_closure_re_anchors_it_as_it_re_anchors_the_cells(weight):
    shown = []
    for integrator in (PathIntegrator(NeuralConfig()), Composition(NeuralConfig(modules=0))):
        cells = Reanchoring(integrator, weight)
        cells.remember(0)
        for step in steps():
            integrator.step(step, 0.05)
        before = cells.pose_odom_robot
        cells.recalibrate(0, np.array([0.2, 0.1, 0.3]))
        shown.append((integrator.pose, cells.pose_odom_robot))
        assert cells.pose_odom_robot == pytest.approx(before, abs=1e-6)
    assert shown[1][0] == pytest.approx(shown[0][0], abs=1e-3)
    if weight == 1.0:
        assert shown[1][0] == pytest.approx([0.2, 0.1, 0.3])


def test_motion_that_no_robot_makes_is_refused_as_by_the_cells():
    for step in ([np.nan, 0.0, 0.0], [2000.0, 0.0, 0.0]):
        for integrator in (PathIntegrator(NeuralConfig()), Composition(NeuralConfig(modules=0))):
            with pytest.raises(StreamError, match="self-motion"):
                integrator.step(step, 0.1)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"neural.modules": 2}, "neural: expected 3 modules or more, or 0 for no cells, found 2"),
        ({"neural.modules": 0, "nodes.rule": "passage"}, "nodes.rule: expected travel or views where neural.modules is 0"),
    ],
)
def test_what_needs_cells_is_refused_without_them(settings, said):
    with pytest.raises(ConfigError, match=said):
        Config.load("rgbd", settings)
    with pytest.raises(ConfigError, match=r"modules: expected 3 or more, found 0"):
        PathIntegrator(NeuralConfig(modules=0))


def test_the_composed_pose_is_that_of_exact_composition():
    numbers, exact = Composition(NeuralConfig(modules=0)), np.zeros(3)
    for step in steps():
        numbers.step(step, 0.05)
        exact = compose(exact, step)
    assert between(exact, numbers.pose) == pytest.approx(np.zeros(3), abs=1e-9)
