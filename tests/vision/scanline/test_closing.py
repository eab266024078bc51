"""Which stretches of the way close a loop: on a ring that is driven twice, with a profile for every place."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from hybridmap.config.vision import MatchingConfig
from hybridmap.geometry import between, compose
from hybridmap.graph.edges import Edge, Lack, Method, Status
from hybridmap.vision.base import Belief
from hybridmap.vision.scanline.closing import AWAY_M, DIFFERENT_M, PAIRS, WITHIN_M, DifferentPlaces, Measured, ScanlineCloser
from hybridmap.vision.scanline.sequences import Sequences

WIDTH, PER_LAP, STEP_M = 32, 100, 0.4


def ring(laps):
    """Poses (N, 3) on a ring of 40 m."""
    angle = 2.0 * np.pi * np.arange(round(laps * PER_LAP)) / PER_LAP
    radius = STEP_M * PER_LAP / (2.0 * np.pi)
    return np.column_stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])


def views(laps, seed=0, noise=0.2):
    """A profile (2, WIDTH) for every node, that changes along the ring within about a metre; lap after lap the same."""
    rng = np.random.default_rng(seed)
    knots = rng.normal(size=(PER_LAP // 2, 2, WIDTH))
    places = np.empty((PER_LAP, 2, WIDTH))
    places[::2] = knots
    places[1::2] = (knots + np.roll(knots, -1, axis=0)) / np.sqrt(2.0)
    count = round(laps * PER_LAP)
    return (places[np.arange(count) % PER_LAP] + noise * rng.normal(size=(count, 2, WIDTH))).astype(np.float32)


@dataclass
class Drive:
    """A drive of the closer alone: `loops` are its edges by key, in their last state."""

    poses: np.ndarray
    profiles: np.ndarray
    bias_rad: float = 0.0
    c_t: float | None = None
    sequence: int = 4
    seconds: float = 1.0
    measured: Measured = field(default_factory=lambda: Measured(np.zeros(3), by_depth=False))
    loops: dict[int, Edge] = field(default_factory=dict)
    first_closed: int | None = None

    def __post_init__(self):
        sequences = Sequences(MatchingConfig(sequence=self.sequence), 2)
        self.closer = ScanlineCloser(sequences, self.measure, self.c_t)
        odometry = [self.poses[0]]
        for node, profile in enumerate(self.profiles):
            step = (
                between(self.poses[node - 1], self.poses[node]) + np.array([0.0, 0.0, self.bias_rad]) if node else np.zeros(3)
            )
            odometry += [compose(odometry[-1], step)] if node else []
            sequences.add(profile)
            self.closer.add_node(step)
            self.belief = belief(np.array(odometry), self.seconds)
            found = self.closer.close(node, self.belief)
            self.loops |= {edge.key: edge for edge in found}
            if self.first_closed is None and any(edge.status is Status.ACCEPTED for edge in found):
                self.first_closed = node
        self.loops |= {edge.key: edge for edge in self.closer.give_up(len(self.profiles))}

    def measure(self, _newer, _older):
        return self.measured

    @property
    def accepted(self):
        return [edge for edge in self.loops.values() if edge.status is Status.ACCEPTED]


def belief(poses, seconds=1.0):
    steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    return Belief(poses, seconds * np.arange(float(len(poses))), np.cumsum(steps), lambda _: np.zeros((len(poses), 3, 3)))


def test_the_second_lap_closes_on_the_first_and_only_rightly():
    drive = Drive(ring(1.6), views(1.6), bias_rad=2e-3)
    assert len(drive.accepted) > 40
    assert all(abs(edge.source - edge.target - PER_LAP) <= 1 for edge in drive.accepted)
    assert all(edge.method is Method.SEQUENCE for edge in drive.accepted)
    assert len({edge.key for edge in drive.accepted}) == len(drive.accepted)


def test_nothing_is_left_waiting_and_a_second_end_changes_nothing():
    drive = Drive(ring(1.6), views(1.6))
    assert not any(edge.status is Status.PENDING for edge in drive.loops.values())
    assert drive.closer.give_up(len(drive.profiles)) == []


def test_one_lap_of_other_places_closes_nothing():
    assert Drive(ring(1.6), np.concatenate([views(1.0), views(0.6, seed=5)])).accepted == []


def test_places_that_all_look_alike_close_nothing():
    """A bare corridor: the best match is no better than the best elsewhere."""
    rng = np.random.default_rng(2)
    alike = (rng.normal(size=(1, 2, WIDTH)) + 0.2 * rng.normal(size=(160, 2, WIDTH))).astype(np.float32)
    assert Drive(ring(1.6), alike).accepted == []


def test_three_matches_are_not_enough_and_a_fourth_brings_the_others():
    again = views(2.0, seed=7)
    again[:PER_LAP] = views(1.0)
    again[PER_LAP + 20 : PER_LAP + 40] = views(1.0, noise=0.0)[20:40]
    drive = Drive(ring(1.6), again[:160])
    first = min(edge.source for edge in drive.accepted)
    assert drive.first_closed is not None
    assert drive.first_closed >= first + 3
    waited = [edge for edge in drive.accepted if edge.source < drive.first_closed]
    assert len(waited) >= 3


def test_matches_that_disagree_with_the_way_are_given_up():
    """Every match says that the robot is half a metre aside, each to another side."""
    rng = np.random.default_rng(3)
    drive = Drive(ring(1.4), views(1.4))
    assert drive.accepted

    class Aside(Drive):
        @property
        def measured(self):
            return Measured(np.array([*rng.uniform(-3.0, 3.0, 2), 0.0]), by_depth=False)

        @measured.setter
        def measured(self, value):
            pass

    lost = Aside(ring(1.4), views(1.4))
    assert len(lost.accepted) < 0.2 * len(drive.accepted)
    assert {edge.lack for edge in lost.loops.values()} >= {Lack.UNSUPPORTED}


def test_matches_agree_through_both_ways_where_the_robot_looks_aside_on_the_second_lap():
    """It looks 20 deg to the left of where it drives: the way of the newer nodes is another than that of the older."""
    poses = ring(1.5)
    poses[PER_LAP:, 2] += np.deg2rad(20.0)

    class Exact(Drive):
        def measure(self, newer, older):
            return Measured(between(poses[newer], poses[older]), by_depth=False)

    assert len(Exact(poses, views(1.5)).accepted) > 30


def test_what_the_gate_does_not_reach_is_not_matched():
    """On the second lap, after some loops, the robot sees what it saw 10 m farther on."""
    profiles = views(1.6)
    profiles[PER_LAP + 30 :] = profiles[PER_LAP - 45 : PER_LAP - 15]
    drive = Drive(ring(1.6), profiles)
    assert any(edge.source < PER_LAP + 30 for edge in drive.accepted)
    assert all(abs(edge.source - edge.target - PER_LAP) < 10 for edge in drive.loops.values() if edge.source > PER_LAP)


def test_a_young_node_is_no_revisit():
    """The same drive in a tenth of the time: everything is younger than the least age."""
    assert Drive(ring(1.6), views(1.6), seconds=0.05).accepted == []


def test_steps_that_turn_the_view_match_nothing():
    poses = ring(1.6)
    poses[PER_LAP + 10 : PER_LAP + 30 : 2, 2] += np.deg2rad(12.0)
    drive = Drive(poses, views(1.6))
    assert not {edge.source for edge in drive.loops.values()} & {*range(PER_LAP + 10, PER_LAP + 30)}


def test_a_given_threshold_needs_no_pairs():
    short, profiles = ring(0.3), views(0.3)
    there_and_again = np.concatenate([short, short])
    twice = np.concatenate([profiles, profiles])
    assert Drive(there_and_again, twice, c_t=0.5).accepted
    assert Drive(there_and_again, twice, c_t=-1.0).accepted == []
    assert Drive(there_and_again[:12], twice[:12], c_t=0.5, sequence=50).loops == {}


def test_the_threshold_is_that_of_pairs_that_lie_apart():
    different, rng = DifferentPlaces(), np.random.default_rng(4)
    assert different.threshold == -np.inf
    count = PAIRS // 10
    for _ in range(12):
        assert different.threshold == -np.inf or different.threshold > 1.0
        scores = np.concatenate([rng.uniform(1.0, 2.0, count), [0.0, 0.0, np.inf]])
        far = np.concatenate([np.full(count, 1.1 * DIFFERENT_M), [0.9 * DIFFERENT_M, 1.1 * DIFFERENT_M, 5.0]])
        travel = np.concatenate([np.full(count, 0.5 * WITHIN_M), [1.0, 1.1 * WITHIN_M, 1.0]])
        different.learn(scores, far, travel)
    assert different.threshold == pytest.approx(1.01, abs=0.01)


def test_a_corrected_gain_rescales_every_way():
    drive = Drive(ring(0.3), views(0.3))
    before = drive.closer.way(3, 20)
    drive.closer.rescale(0.9)
    assert drive.closer.way(3, 20) == pytest.approx(before * [0.9, 0.9, 1.0])
    assert before[0] > AWAY_M
