import numpy as np
import pytest

from hybridmap.vision.templates import (
    Matcher,
    Mode,
    ProfileStore,
    ViewTemplates,
    band_weights,
    combine,
    shifted_differences,
)


def printed_g(c, first, second):
    """Equation 12, as printed."""
    b = len(first)
    return sum(abs(first[i + max(c, 0)] - second[i - min(c, 0)]) for i in range(b - abs(c))) / (b - abs(c))


def smooth(rng, *shape):
    kernel = np.ones(5) / 5.0
    return np.apply_along_axis(lambda row: np.convolve(row, kernel, "same"), -1, rng.normal(size=shape)) * 2.0


def test_differences_are_equation_12():
    rng = np.random.default_rng(1)
    query, stored = rng.normal(size=(2, 16)), rng.normal(size=(2, 5, 16))
    shifts = np.arange(-7, 8)
    g = shifted_differences(query, stored, shifts)
    for n in range(5):
        for band in range(2):
            expected = [printed_g(int(c), query[band], stored[band, n]) for c in shifts]
            assert np.allclose(g[n, band], expected)


def test_a_shifted_view_is_found_at_its_shift():
    rng = np.random.default_rng(2)
    scene = smooth(rng, 1, 100).astype(np.float32)
    store = ProfileStore(max_shift=16)
    store.add(scene[:, 20:84])
    query = scene[:, 13:77]  # things lie 7 columns farther right
    g = store.differences(query)
    _, shift = combine(g, store.shifts, "plain", np.ones(1))
    assert shift[0] == 7
    assert g.min() == pytest.approx(0.0, abs=1e-9)


def test_every_reading_of_G_by_hand():
    g = np.array([[[0.2, 0.6], [0.5, 0.7]], [[0.8, 1.0], [0.9, 1.1]]])  # 2 stored, bands R and D, 2 shifts
    weights = band_weights(2, 0.7, 0.3)
    shifts = np.array([0, 1])
    bar_r, bar_d = 0.5, 0.7  # means of g_min over the templates
    expected: dict[Mode, float] = {
        "literal": 0.7 * abs(0.2 - bar_r) + 0.3 * abs(0.5 - bar_d),
        "ratio": 0.7 * 0.2 / bar_r + 0.3 * 0.5 / bar_d,
        "signed": 0.7 * (0.2 - bar_r) + 0.3 * (0.5 - bar_d),
        "plain": 0.7 * 0.2 + 0.3 * 0.5,
    }
    for mode, value in expected.items():
        score, _ = combine(g, shifts, mode, weights)
        assert score[0] == pytest.approx(value), mode
    of_pair, _ = combine(g, shifts, "ratio", weights, g_bar="shifts")
    assert of_pair[0] == pytest.approx(0.7 * 0.2 / 0.4 + 0.3 * 0.5 / 0.6)


def test_literal_is_inverted_and_the_others_are_not():
    rng = np.random.default_rng(3)
    stored = smooth(rng, 40, 2, 64)
    ranks = {}
    for mode in ("literal", "ratio", "signed", "plain", "four-band"):
        matcher = Matcher(mode, 0.7, 0.3, max_shift=8)
        for profile in stored:
            matcher.add(profile)
        query = stored[11] + rng.normal(scale=0.1, size=(2, 64))
        score = matcher.score(query, np.arange(40)).score
        ranks[mode] = int((score < score[11]).sum())
    assert ranks["literal"] == 39
    assert {ranks[mode] for mode in ("ratio", "signed", "plain", "four-band")} == {0}


def test_weights_sum_to_one():
    assert band_weights(8, 0.7, 0.3).sum() == pytest.approx(1.0)
    assert band_weights(1, 0.7, 0.3) == pytest.approx([1.0])
    assert band_weights(8, 0.7, 0.3)[:4] == pytest.approx(np.full(4, 0.175))


def test_g_bar_is_over_all_stored_templates_even_for_some_candidates():
    rng = np.random.default_rng(4)
    matcher = Matcher("ratio", 0.5, 0.5, max_shift=4)
    for profile in smooth(rng, 30, 2, 32):
        matcher.add(profile)
    query = smooth(rng, 2, 32)
    every = matcher.score(query, np.arange(30)).score
    some = matcher.score(query, np.array([3, 17])).score
    assert some == pytest.approx(every[[3, 17]])


def test_store_grows():
    rng = np.random.default_rng(6)
    profiles = rng.normal(size=(200, 2, 16)).astype(np.float32)
    store = ProfileStore(max_shift=2)
    assert [store.add(p) for p in profiles] == list(range(200))
    assert np.array_equal(store.profile(150), profiles[150])
    assert np.argmin(store.differences(profiles[150])[:, :, 2].sum(axis=1)) == 150


def test_a_template_is_founded_only_when_the_view_stays_new():
    rng = np.random.default_rng(7)
    a, b = smooth(rng, 2, 64).astype(np.float32), smooth(rng, 2, 64).astype(np.float32)
    templates = ViewTemplates(max_shift=2, mu_r=0.5, mu_d=0.5)
    assert templates.recognise(a).founded
    assert not templates.recognise(b).founded
    assert not templates.recognise(a).founded  # back again: b was not stable
    seen = [templates.recognise(b) for _ in range(4)]
    assert [s.founded for s in seen] == [False, False, True, False]
    assert seen[-1].template == 1
    assert len(templates) == 2


def test_a_template_of_another_threshold_is_made_at_once_and_a_match_tells_its_shift():
    rng = np.random.default_rng(5)
    view = rng.normal(size=(2, 32)).astype(np.float32)
    templates = ViewTemplates(max_shift=4, mu_r=0.5, mu_d=0.5, threshold=0.05, stable_frames=1)
    assert templates.recognise(view).founded
    again = templates.recognise(np.roll(view, 3, axis=1))
    assert (again.founded, again.template, again.shift) == (False, 0, 3)
    other = templates.recognise(view + 0.2 * rng.normal(size=view.shape).astype(np.float32))
    assert (other.founded, other.template, other.shift) == (True, 1, 0)
    loose = ViewTemplates(max_shift=4, mu_r=0.5, mu_d=0.5, threshold=0.5, stable_frames=1)
    loose.recognise(view)
    assert not loose.recognise(view + 0.2 * rng.normal(size=view.shape).astype(np.float32)).founded
