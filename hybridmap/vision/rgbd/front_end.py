"""The RGB-D front-end: frames in, proposals of edges out."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import Array, RelativePose
from hybridmap.graph.edges import Check, Edge
from hybridmap.metrics import StageClock
from hybridmap.streams.base import Observation, Rig
from hybridmap.streams.rgbd import RGBD, Camera, RgbdFrame, checked_frame
from hybridmap.vision.base import HELD_IMAGES, UNEXPECTED, Belief, Division, View, held
from hybridmap.vision.profile import image_profile
from hybridmap.vision.rgbd import checks
from hybridmap.vision.rgbd.closing import LoopCloser
from hybridmap.vision.rgbd.depth_grid import DepthGrid, cell_px, make_grid, place
from hybridmap.vision.rgbd.features import Features, detect
from hybridmap.vision.rgbd.keyframe import (
    Keyframe,
    WorkingImage,
    working_camera,
    working_factor,
    working_image,
)
from hybridmap.vision.rgbd.meeting import FeatureMeeting
from hybridmap.vision.rgbd.noise_level import NoiseLevel
from hybridmap.vision.rgbd.pnp import Verifier
from hybridmap.vision.rgbd.posture import Posture
from hybridmap.vision.rgbd.stance import Stance
from hybridmap.vision.rgbd.tracking import Tracker, odometry_sigma
from hybridmap.vision.rgbd.witness import FeatureWitness
from hybridmap.vision.templates import ViewTemplates


class RgbdFrontEnd:
    """The RGB-D front-end: profiles, depth registration of consecutive nodes, loops verified by features and depth.

    Implements `vision.base.VerifyingFrontEnd`, `PartingFrontEnd`, `MeetingFrontEnd` and `second_opinion.LocalisingFrontEnd`.

    Args:
        config: settings of the visual side.
        camera: pinhole and mounting of the frames.
        seed: seed of RANSAC.
        clock: measures the time of the search for candidates (stage `search`).

    Attributes:
        keyframes: of all nodes, by node number.
        verifier: measures the relative pose of two keyframes.
        closer: finds loops.
        witness: tells where on the whole map features fit; None if they are not compared, or the robot never counts as lost.
    """

    def __init__(self, config: VisionConfig, camera: Camera, seed: int, clock: StageClock | None = None) -> None:
        rgbd, matching = config.rgbd, config.matching
        self._config = config
        self._full_camera = camera
        self._factor = working_factor(camera, rgbd.max_width_px)
        self._camera = working_camera(camera, rgbd.max_width_px)
        self._cell_px = cell_px(self._camera.width_px)
        self._bands = config.profile.bands if rgbd.matching == "four-band" else 1
        self._templates = ViewTemplates(config.profile.width // 16, matching.mu_r, matching.mu_d)
        self.keyframes: list[Keyframe] = []
        self._images: deque[tuple[int, RgbdFrame]] = deque(maxlen=HELD_IMAGES)
        keys = itertools.count()
        level = NoiseLevel()
        self._tracker = Tracker(self.keyframes, config, self._camera, level, keys.__next__)
        self.verifier = Verifier(self._camera, rgbd.pnp.min_inliers, rgbd.registration.depth_sigma, level, seed)
        self._posture = Posture(rgbd.tilt, camera.T_base_camera, self.verifier.solver)
        self.closer = LoopCloser(
            self.keyframes,
            config,
            self.verifier,
            self._yaw_of_shift,
            keys.__next__,
            clock or StageClock(),
        )
        self._meeting = FeatureMeeting(self.closer, keys.__next__, config.closing.revisit_rounds)
        verified = config.relocalising.enabled and rgbd.verify != "none"
        self.witness = FeatureWitness(self.closer, keys.__next__) if verified else None
        self._frame: RgbdFrame | None = None
        self._image: WorkingImage | None = None

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Compute the profile of one frame and recognise its view template; `delta_node_robot` is not used.

        Raises:
            StreamError: not an RGB-D frame, or its size is not the camera's.
        """
        self._frame = checked_frame(frame, self._full_camera)
        self._image = working_image(self._frame, self._factor)
        settings = self._config.profile
        profile = image_profile(self._image.grey, self._image.depth_m, settings.width, self._bands, settings.normalise)
        seen = self._templates.recognise(profile)
        return View(frame.stamp_ns, profile, seen.template, seen.founded)

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the frame observed last: keep its features, surface and images; see `FrontEnd.add_node`.

        Raises:
            ValueError: no frame was observed yet, or `node` is not the next number.
        """
        if self._frame is None or self._image is None or node != len(self.keyframes):
            raise ValueError(f"vision: found node {node}, expected node {len(self.keyframes)} after a frame was observed")
        features, grid = self._seen(self._image)
        stance = self._posture.stance(grid, features, self.keyframes[-1] if self.keyframes else None)
        self._keep(Keyframe(view.profile, features, place(grid, stance)))
        self._images.append((node, self._frame))

    def _seen(self, image: WorkingImage) -> tuple[Features, DepthGrid]:
        """The features and the depth grid of a picture."""
        sigma = self._config.rgbd.registration.depth_sigma
        return detect(image.grey, image.depth_m, self._camera), make_grid(image.depth_m, self._camera, self._cell_px, sigma)

    def _keep(self, keyframe: Keyframe) -> None:
        self.keyframes.append(keyframe)
        self.closer.add_node(keyframe.profile)

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Register the new node to the two before it; see `FrontEnd.track`.

        Returns no edges for the first node, nor where `vision.tracking.enabled` is false.
        """
        steps = self._tracker.track(node, odometry)
        self.closer.tracked(node, steps)
        return steps

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loop closures of the new node; see `FrontEnd.close`."""
        return self.closer.close(node, belief)

    def finish(self, belief: Belief) -> list[Edge]:
        """At the end of the drive, compare nodes near each other on the optimised map, and decide all pending loops."""
        return self.closer.finish(belief)

    def verify(self, outliers: Sequence[Edge], belief: Belief) -> list[Edge]:
        """Measure again, from the poses of the map, loops that a back-end down-weighted; see `LoopCloser.verify`."""
        return self.closer.verify(outliers, belief)

    def overrules(self, registration: RelativePose, odometry: RelativePose) -> bool:
        """Whether a good registration says that the odometry is wrong; see `Overruling.overrules`."""
        return odometry_sigma(registration, odometry) > checks.CONTRADICTION_SIGMA

    @property
    def reach_m(self) -> float:
        """Zero: a loop is measured by the frames of its two nodes alone."""
        return 0.0

    def way(self, node: int) -> tuple[Check, ...]:
        """Check that the depth of a node fits that of the one before, not much worse than nearly always; see `Tracker.way`."""
        return self._tracker.way(node)

    def unexpected(self, loop: Edge) -> bool:
        """Whether a loop was refused only because it is far from where the map has it, or as no other one agreed with it."""
        return loop.lack in UNEXPECTED and checks.unexpected(loop.failed)

    def divided(self, place: int, poses: Array) -> Division | None:
        """None: each loop is measured by two frames, so that loops tell the node of a kidnapping by themselves."""

    def part(self, node: int) -> None:
        """Nothing to do: no measurement joins frames of more than two nodes."""

    @property
    def lost_since(self) -> int | None:
        """First node since the last loop closure whose view fits none of those before it (broken motion); None if all fit."""
        return self.closer.lost_since

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """Arrays of a node's frame for the map file.

        Keys: `profile` (bands, width) float32; `color` (H, W, 3) uint8 and `depth_mm` (H, W) uint16, of full size; and
        `T_base_camera` (4, 4), the camera on the robot at that time. The node closed last has those of `LoopCloser.note` too.

        Raises:
            StreamError: the node's images are no longer held (see `HELD_IMAGES`); the map file has them.
        """
        kept = self.keyframes[node]
        return {
            "profile": kept.profile,
            **RGBD.compact(held(self._images, node)),
            "T_base_camera": kept.surface.stance.T_base_camera,
            **self.closer.note(node),
        }

    def state(self, node: int) -> dict[str, NDArray[np.generic]]:
        """`stance` (3,) of a node: uncertainty of tilt (rad) and height (m), and whether they were estimated there."""
        stance = self.keyframes[node].surface.stance
        return {"stance": np.array([stance.tilt_sigma_rad, stance.height_sigma_m, stance.held])}

    def restore(
        self, node: int, keyframe: Mapping[str, NDArray[np.generic]], state: Mapping[str, NDArray[np.generic]], begins: bool
    ) -> None:
        """Take up a node of a finished session; see `MeetingFrontEnd.restore`. `begins` is not used: see `part`."""
        del begins
        frame = RGBD.restore(keyframe, 0)
        if frame is None or "stance" not in state:
            found = ", ".join([*keyframe, *state]) or "nothing"
            raise StreamError(
                f"RGB-D: node {node} of a stored map: expected a picture with depth and its stance, found {found}; "
                f"map its source again"
            )
        features, grid = self._seen(working_image(checked_frame(frame, self._full_camera), self._factor))
        tilt_sigma_rad, height_sigma_m, was_held = np.asarray(state["stance"]).tolist()
        stance = Stance(np.asarray(keyframe["T_base_camera"]), tilt_sigma_rad, height_sigma_m, bool(was_held))
        self._keep(Keyframe(np.asarray(keyframe["profile"], dtype=np.float32), features, place(grid, stance)))

    def arrive(self, first: int, *, guessed: bool = False) -> None:
        """A session begins whose place on the map is to be found; see `MeetingFrontEnd.arrive`. All are compared anyway."""
        del guessed
        self._meeting.arrive(first)

    def meet(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loops of a node to earlier sessions; see `MeetingFrontEnd.meet`."""
        return self._meeting.meet(node, belief)

    def meet_again(self, belief: Belief) -> list[Edge]:
        """Compare nodes near each other on the map, and decide what is pending; see `MeetingFrontEnd.meet_again`."""
        return self._meeting.meet_again(belief)

    def _yaw_of_shift(self, shift: int) -> float:
        """Yaw of the stored view seen from the query: things farther right in the query mean that it looks farther left."""
        pixels = shift * self._camera.width_px / self._config.profile.width
        return -float(np.arctan2(pixels, self._camera.fx_px))


def create(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> RgbdFrontEnd:
    """Make the RGB-D front-end for the camera of a rig."""
    return RgbdFrontEnd(config, rig.sensors[RGBD.sensor_name], seed, clock)
