"""Panoramic profiles: a place is known again from any side, and their leads say where the robot is."""

import numpy as np
import pytest

from hybridmap.geometry import between, wrap_angle
from hybridmap.streams.laser import Laser
from hybridmap.vision.laser.cloud import INDOORS, cloud_of_scan
from hybridmap.vision.laser.hypotheses import LEADS
from hybridmap.vision.laser.panorama import APART_M, EVERY_M, HALF_M, Leads, Panoramas
from hybridmap.vision.laser.submap import Atlas
from tests.vision.laser.laser_worlds import cast, ring, ring_drive

AHEAD = Laser(np.deg2rad(np.arange(-90.0, 91.0, 1.0)), 0.05, 30.0, np.array([0.1, 0.0, 0.0]))
WIDTH = 64


def there_and_back():
    """A drive once around the ring, then around it the other way."""
    lap = ring_drive(1.0)
    back = lap[::-1] + np.array([0.0, 0.0, np.pi])
    return np.concatenate([lap, back])[::4]


def driven(truth, node_by_node=False):
    rng, atlas = np.random.default_rng(1), Atlas()
    panoramas = Panoramas(atlas, WIDTH)
    for pose in truth:
        ranges = cast(ring(), pose, rng, AHEAD)
        atlas.add(cloud_of_scan(ranges, AHEAD, INDOORS), ranges, between(truth[0], pose), np.zeros((3, 3)))
        if node_by_node:
            panoramas.extend()
    return atlas, panoramas


@pytest.fixture(scope="module")
def back():
    truth = there_and_back()
    atlas, panoramas = driven(truth)
    panoramas.extend(to_the_end=True)
    return truth, atlas, panoramas


def test_there_is_a_panorama_a_metre(back):
    _, atlas, panoramas = back
    travel = np.array(atlas.travel_m)
    wanted = np.arange(0.0, travel[-1], EVERY_M)
    assert panoramas.nodes == np.unique(np.searchsorted(travel, wanted)).tolist()


def test_a_panorama_is_made_once_the_scans_around_it_are_there():
    atlas, panoramas = driven(there_and_back()[:60])
    panoramas.extend()
    left_m = atlas.travel_m[-1] - HALF_M
    assert left_m - EVERY_M < atlas.travel_m[panoramas.nodes[-1]] <= left_m
    panoramas.extend(to_the_end=True)
    assert atlas.travel_m[-1] - atlas.travel_m[panoramas.nodes[-1]] < EVERY_M


def test_an_empty_drive_has_none():
    panoramas = Panoramas(Atlas(), WIDTH)
    panoramas.extend(to_the_end=True)
    assert panoramas.nodes == []


def test_when_they_are_made_changes_nothing(back):
    truth, _, panoramas = back
    _, online = driven(truth, node_by_node=True)
    online.extend(to_the_end=True)
    assert online.nodes == panoramas.nodes
    for number in range(len(online.nodes) - round(HALF_M / EVERY_M)):
        assert online.alike(number).numbers.tolist() == panoramas.alike(number).numbers.tolist()


def test_only_earlier_passes_are_proposed(back):
    _, atlas, panoramas = back
    travel = np.array(atlas.travel_m)[panoramas.nodes]
    for number in range(len(travel)):
        assert (travel[number] - travel[panoramas.alike(number).numbers] > APART_M - 1e-6).all()
    assert len(panoramas.alike(0).numbers) == 0


def test_a_laser_that_looks_ahead_knows_the_way_again_from_the_other_side(back):
    truth, _, panoramas = back
    first = len(truth) // 2 + 10
    right = []
    for node in range(first, len(truth) - 20, 10):
        leads = panoramas.leads(node, np.arange(node - 6, node + 7))
        found = np.array([pose for _, pose in leads.agreed()[:LEADS]])
        off = between(between(truth[0], truth[node]), found)
        near = (np.hypot(off[:, 0], off[:, 1]) < 1.0) & (np.abs(wrap_angle(off[:, 2])) < np.deg2rad(8.0))
        right.append(near.any())
    assert len(right) > 10
    assert np.mean(right) > 0.7


def leads_of(rows):
    """Leads from rows of panorama, old node, pose, difference."""
    panoramas, old, poses, differences = zip(*rows, strict=True)
    return Leads(np.array(panoramas), np.array(old), np.array(poses, dtype=float), np.array(differences))


def test_the_pose_on_which_most_panoramas_agree_comes_first():
    alone = [(0, 7, (9.0, 0.0, 0.0), 0.01), (0, 8, (9.3, 0.0, 0.0), 0.02), (0, 9, (9.6, 0.0, 0.0), 0.03)]
    agreed = [(1, 3, (0.0, 0.0, np.pi - 0.05), 0.3), (2, 4, (0.4, 0.0, 0.05 - np.pi), 0.2)]
    [(old, pose), (other, _)] = leads_of(alone + agreed).agreed()
    assert (old, other) == (4, 7)
    assert pose[:2] == pytest.approx([0.2, 0.0])
    assert abs(wrap_angle(pose[2] - np.pi)) < 1e-9


def test_leads_are_counted_once_and_none_make_no_group():
    turned = [(0, 1, (0.0, 0.0, 0.0), 0.2), (1, 2, (0.0, 0.0, 1.0), 0.1), (2, 3, (5.0, 0.0, 0.0), 0.3)]
    assert [old for old, _ in leads_of(turned).agreed()] == [2, 1, 3]
    assert leads_of(turned).where(np.zeros(3, dtype=bool)).agreed() == []
