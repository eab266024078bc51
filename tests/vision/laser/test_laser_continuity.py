"""What shows that a laser robot was carried, and what does not."""

import numpy as np
import pytest

from hybridmap.config.vision import RelocalisingConfig, VisionConfig
from hybridmap.geometry import IDENTITY, RelativePose, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Status, at_least
from hybridmap.streams.laser import LaserScan
from hybridmap.vision.base import Belief
from hybridmap.vision.laser.cloud import cloud_of_scan
from hybridmap.vision.laser.kidnapping import ChainBreak, Continuity
from hybridmap.vision.laser.submap import Atlas
from hybridmap.vision.laser.tracking import Step, Tracker
from tests.vision.laser.laser_worlds import LASER, box, cast, ring, ring_drive, room

SURE = np.diag([0.05, 0.05, np.deg2rad(1.0)]) ** 2
OTHER_ROOM = np.array([(-30.0, 9.0, 30.0, 9.0), (-20.0, 9.0, 5.0, -30.0)])


class Chain:
    """An atlas of scans that were taken at some poses and believed to be at others, as the map has them."""

    def __init__(self, taken, believed, world, config=None):
        rng = np.random.default_rng(4)
        config = config or VisionConfig()
        self.atlas, self.poses = Atlas(), np.asarray(believed, float)
        for at, pose in zip(taken, self.poses, strict=True):
            self.add(cast(world, at, rng), pose)
        self.continuity = Continuity(config, self.atlas, LASER, Tracker(self.atlas))

    def add(self, ranges, pose):
        self.atlas.add(cloud_of_scan(ranges, LASER), ranges, pose, np.zeros((3, 3)))

    def belief(self, sigma_m=0.05):
        n = len(self.poses)
        covariance = np.tile(np.diag([0.5 * sigma_m**2, 0.5 * sigma_m**2, 1e-4]), (n, 1, 1))
        return Belief(self.poses, np.arange(n, dtype=float), np.array(self.atlas.travel_m), lambda _: covariance)


def stepped(worlds, step, odometry, measured=True, config=None):
    """What is said of a step of 0.4 m straight on, which began in the room, as its scans in a row see these worlds."""
    rng, along = np.random.default_rng(5), np.linspace(0.0, 1.0, len(worlds) + 1)[1:, None]
    start, way, wheels = np.array([-1.5, 0.0, 0.0]), along * [0.4, 0.0, 0.0], along * odometry
    scans = [LaserScan(i, cast(world, compose(start, at), rng)) for i, (world, at) in enumerate(zip(worlds, way, strict=True))]
    chain = Chain([start], [IDENTITY], room(), config)
    chain.add(scans[-1].ranges_m, compose(IDENTITY, step))
    relative, asked = RelativePose(np.asarray(step, float), SURE), (at_least("inliers", float(measured), 0.5),)
    judged = Step(relative, asked, contradicts_odometry=False, inliers=1.0, fit=1.0, scatter=SURE)
    on_the_way = list(zip(wheels[:-1], scans[:-1], strict=True))
    return chain.continuity.broken(1, judged, RelativePose(np.asarray(odometry, float), SURE), on_the_way)


TURNED = [0.4, 0.0, np.deg2rad(20.0)]
STRAIGHT = [0.4, 0.0, 0.0]


def missed(checks):
    return [check.figure for check in checks if not check.passed]


def test_a_drop_out_of_the_wheels_is_no_carry():
    assert stepped([room()] * 4, STRAIGHT, TURNED) == ()
    assert stepped([room()] * 4, STRAIGHT, [1.6, 0.0, 0.0]) == ()


@pytest.mark.parametrize("seen_before", [0, 2, 4])
def test_another_room_is_a_carry_where_it_fits_nowhere_or_contradicts_the_wheels(seen_before):
    worlds = [room()] * seen_before + [OTHER_ROOM] * (5 - seen_before)
    assert missed(stepped(worlds, STRAIGHT, STRAIGHT, measured=False)) == ["violation"]
    far = stepped(worlds, TURNED, STRAIGHT)
    assert missed(far) == ["odometry_sigma", "violation"]
    assert far[0].value == pytest.approx(20.0, abs=0.5)


def test_wheels_and_scans_that_agree_are_believed():
    assert stepped([OTHER_ROOM], STRAIGHT, STRAIGHT) == ()


def test_people_who_step_into_view_while_the_wheels_drop_out_are_no_carry():
    """The scans of the two nodes look through each other's walls, but each follows on the one before it."""
    crowd = [np.concatenate([room(), box(0.2, -width, 0.5, width)]) for width in np.arange(0.1, 2.1, 0.1)]
    assert stepped(crowd, STRAIGHT, TURNED) == ()
    assert "violation" in missed(stepped(crowd[-1:], STRAIGHT, TURNED))


def test_it_can_be_switched_off():
    config = VisionConfig(relocalising=RelocalisingConfig(enabled=False))
    assert stepped([OTHER_ROOM], STRAIGHT, STRAIGHT, measured=False, config=config) == ()


SEEN_BEFORE = np.array([(4.0, -3.0, 4.0, 3.0), (4.0, -1.0, 3.1, -1.0), *box(-1.0, 2.4, 0.7, 3.0)])
"""Of the room, what gave returns before the break: two fifths of the points of a scan of all of it fit there."""
BREAK = 12


def after_a_false_break(beside_m):
    """What six scans in a row after a break say, of a robot that is so far beside where the wheels have it."""
    rng, way = np.random.default_rng(4), np.array([[-1.5 + 0.1 * k, 0.0, 0.0] for k in range(BREAK + 7)])
    chain = Chain(way[:BREAK], way[:BREAK], SEEN_BEFORE)
    for pose in way[BREAK:]:
        chain.add(cast(room(), compose(pose, np.array([0.0, beside_m, 0.0])), rng), pose)
    chain.atlas.part(BREAK)
    refused = Edge(BREAK - 1, BREAK, EdgeKind.REGISTRATION, Status.REJECTED, None)
    broken = ChainBreak(BREAK, refused, between(way[BREAK - 1], way[BREAK]), None)
    return [chain.continuity.drove_on([broken], node) for node in range(BREAK + 1, len(way))]


def test_four_faint_fits_where_the_wheels_have_the_robot_mend_the_chain():
    """Among trees a scan shares few points with those before it, and no single one tells."""
    assert after_a_false_break(beside_m=0.0) == [None, None, None, True, True, True]


@pytest.mark.parametrize("beside_m", [0.35, 1.0])
def test_faint_fits_elsewhere_mend_nothing(beside_m):
    assert set(after_a_false_break(beside_m)) == {None}


LAP, DOWN, PER_LAP, AFTER = ring_drive(2.1)[::5], 124, 108, 12
"""Nodes of two laps of the ring; from the second lap on they are known. At node 124 the robot is carried, and drives on."""


def carried(onward):
    """The robot goes on so many nodes farther along the ring, and is believed to have driven on where it was."""
    on = LAP[DOWN + onward : DOWN + onward + AFTER]
    return Chain(np.concatenate([LAP[:DOWN], on]), np.concatenate([LAP[:DOWN], compose(LAP[DOWN], between(on[0], on))]), ring())


@pytest.fixture(scope="module")
def driven():
    return Chain(LAP[: DOWN + AFTER], LAP[: DOWN + AFTER], ring())


def test_a_map_that_shows_walls_where_the_robot_looks_through_contradicts(driven):
    last, chain = DOWN + AFTER - 1, carried(66)
    assert chain.continuity.contradicted(last, chain.belief())
    assert not chain.continuity.contradicted(last, chain.belief(sigma_m=0.5))
    assert not driven.continuity.contradicted(last, driven.belief())


def test_in_a_place_that_was_never_seen_nothing_contradicts():
    first_lap = Chain(LAP[:60], LAP[:60], ring())
    assert not first_lap.continuity.contradicted(59, first_lap.belief())


def sightings(onward):
    """Loops from the last four nodes to old ones of the first lap, where they would be if the robot had been carried."""
    out = []
    for node in range(DOWN + AFTER - 4, DOWN + AFTER):
        there = LAP[node + onward]
        old = int(np.argmin(np.hypot(*(LAP[:PER_LAP] - there)[:, :2].T)))
        out.append(Edge(node, old, EdgeKind.LOOP, Status.ACCEPTED, RelativePose(between(there, LAP[old]), SURE)))
    return out


@pytest.mark.parametrize("onward", [10, 40, 66])
def test_where_nothing_showed_the_carry_the_old_map_tells_when_it_was(onward):
    chain = carried(onward)
    assert chain.continuity.kidnapped_unnoticed(sightings(onward), chain.belief()) == DOWN


def test_a_chain_that_may_have_drifted_so_far_was_not_carried():
    chain = carried(10)
    assert chain.continuity.kidnapped_unnoticed(sightings(10), chain.belief(sigma_m=0.5)) is None


def test_a_chain_that_fits_the_map_as_it_is_was_not_carried(driven):
    assert driven.continuity.kidnapped_unnoticed(sightings(40), driven.belief()) is None
