import numpy as np
import pytest

from hybridmap.config.mapping import NeuralConfig, PlaceConfig
from hybridmap.neural import PathIntegrator
from hybridmap.neural import place as place_cells
from hybridmap.neural.grid import shift_sheets
from hybridmap.neural.place import PlaceCells


@pytest.fixture(scope="module")
def integrator():
    return PathIntegrator(NeuralConfig())


def sheets_at(integrator, x, y):
    return shift_sheets(integrator.grid.activity, integrator.bands.wave_vectors[:, [0, 2]] @ np.array([x, y]))


def cells(integrator, **settings):
    return PlaceCells(PlaceConfig(**settings), 32, integrator.spacings_m)


def test_a_new_place_recruits_one_cell_and_an_old_one_none(integrator):
    place = cells(integrator)
    for x in (0.0, 0.01, 1.0, 1.01, 0.0):
        place.learn(sheets_at(integrator, x, 0.0))
    assert len(place.weights) == 2
    assert place.rates(sheets_at(integrator, 0.0, 0.0)) == pytest.approx([1.0, 0.0], abs=1e-2)
    assert place.rates(sheets_at(integrator, 1.0, 0.0)) == pytest.approx([0.0, 1.0], abs=1e-2)


def test_weights_stay_bounded_under_learning(integrator):
    place = cells(integrator, learning_rate=0.5)
    rng = np.random.default_rng(0)
    for _ in range(400):
        place.learn(sheets_at(integrator, *rng.uniform(-0.2, 0.2, 2)))
    assert place.weights.min() >= 0.0
    assert np.linalg.norm(place.weights, axis=1) == pytest.approx(np.ones(len(place.weights)), abs=1e-5)


def test_learning_moves_a_field_towards_where_the_cell_fires(integrator):
    place = cells(integrator, learning_rate=0.2)
    place.learn(sheets_at(integrator, 0.0, 0.0))
    there = sheets_at(integrator, 0.02, 0.0)
    before = place.rates(there)[0]
    for _ in range(20):
        place.learn(there)
    assert place.rates(there)[0] > before + 0.01


def test_fields_are_single(integrator):
    place = cells(integrator)
    rng = np.random.default_rng(2)
    for _ in range(60):
        place.learn(sheets_at(integrator, *rng.uniform(-0.5, 0.5, 2)))
    far = 0
    ticks = np.linspace(-0.7, 0.7, 29)
    maps = np.array([[place.rates(sheets_at(integrator, x, y)) for y in ticks] for x in ticks])
    for cell in range(maps.shape[-1]):
        i, j = np.unravel_index(int(maps[..., cell].argmax()), maps.shape[:2])
        dx, dy = np.meshgrid(ticks - ticks[i], ticks - ticks[j], indexing="ij")
        far += bool((maps[..., cell][np.hypot(dx, dy) > 0.15] > 0.2 * maps[..., cell].max()).any())
    assert far <= 0.05 * maps.shape[-1]


def test_recruitment_stops_at_the_limit_and_says_so(integrator, caplog, monkeypatch):
    monkeypatch.setattr(place_cells, "MAX_CELLS", 3)
    place = cells(integrator)
    for x in range(6):
        place.learn(sheets_at(integrator, float(x), 0.0))
    assert len(place.weights) == 3
    assert "all 3 place cells" in caplog.text
