import numpy as np
import pytest

from hybridmap.config.mapping import NeuralConfig, PlaceConfig
from hybridmap.neural import PathIntegrator
from hybridmap.neural import place as place_cells
from hybridmap.neural.grid import shift_sheets
from hybridmap.neural.place import RECRUIT_THRESHOLD, PlaceCells, PlaceProjection
from tests.neural.neural_drives import wander


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


def test_cells_asked_around_the_robot_fire_as_if_all_were_asked():
    integrator = PathIntegrator(NeuralConfig())
    near, every = cells(integrator), cells(integrator)
    deltas, poses = wander(3, 30.0)
    silent, learnt = 0, range(3, len(deltas), 4)
    for k, delta in enumerate(deltas):
        integrator.step(delta, 1 / 30)
        if k not in learnt:
            continue
        here, sheets = poses[k, :2], integrator.grid.activity
        fired = near.learn(sheets, here)
        of_all = near.rates(sheets)
        elsewhere = np.ones(len(of_all), dtype=bool)
        elsewhere[fired.cells] = False
        every.learn(sheets)
        assert fired.rates == pytest.approx(of_all[fired.cells], abs=2e-3)  # one step of learning between them
        assert np.array_equal(fired.cells, near.around(here))
        assert of_all[elsewhere].max(initial=0.0) < RECRUIT_THRESHOLD
        silent += not of_all[elsewhere].any()
    assert silent >= 0.75 * len(learnt)
    assert len(near.weights) == len(every.weights)


def test_a_step_asks_no_more_cells_however_many_there_are(integrator):
    place, counts, asked = cells(integrator), [], []
    straight = [(x, 0.0) for x in np.arange(0.0, 40.0, 0.05)]
    lap = [(np.cos(angle), np.sin(angle)) for angle in np.arange(0.0, 2.0 * np.pi, 0.05)]
    for x, y in straight + 4 * lap:
        place.learn(sheets_at(integrator, x, y), np.array([x, y]))
        counts.append(len(place.weights))
        asked.append(len(place.around(np.array([x, y]))))
    quarter, laps = len(straight) // 4, len(straight) + len(lap)
    assert counts[len(straight) - 1] > 3.5 * counts[quarter]
    assert max(asked[: len(straight)]) <= max(asked[:quarter])
    assert max(asked[laps:]) <= 1.1 * max(asked[len(straight) : laps])


def test_what_fires_is_told_by_the_cells_that_were_asked_alone(integrator):
    """So that a step lists no rate of the thousands of cells elsewhere; what they project is the same."""
    place, projection, by_all = cells(integrator), PlaceProjection(4), PlaceProjection(4)
    bumps = np.eye(4, dtype=np.float32)
    for k, x in enumerate(np.arange(0.0, 20.0, 0.05)):
        fired = place.learn(sheets_at(integrator, x, 0.0), np.array([x, 0.0]))
        every = np.zeros(len(place.weights), dtype=np.float32)
        every[fired.cells] = fired.rates
        assert projection.onto(*fired[::-1]) == pytest.approx(by_all.onto(every))
        projection.learn(fired.rates, bumps[k % 4], fired.cells)
        by_all.learn(every, bumps[k % 4])
    assert len(place.weights) > 256  # more than there is room for at first
    assert len(fired.cells) < 0.1 * len(place.weights)


def test_newly_recruited_cells_project_nothing_until_they_fire():
    projection, bumps = PlaceProjection(4), np.eye(4, dtype=np.float32)
    projection.learn(np.array([1.0, 0.0], np.float32), bumps[0])
    assert projection.onto(np.array([1.0, 0.0, 1.0], np.float32)) == pytest.approx(bumps[0])
    many = np.zeros(1000, np.float32)
    many[[0, 999]] = 1.0, 0.5
    assert projection.onto(many) == pytest.approx(bumps[0])
    projection.learn(many, bumps[2])
    assert projection.onto(many) == pytest.approx(0.5 * bumps[0] + 1.0 * bumps[2])
    of_two = np.stack([many, 0.0 * many], axis=1)
    assert projection.onto(of_two)[:, 0] == pytest.approx(projection.onto(many))
    assert not projection.onto(of_two)[:, 1].any()
