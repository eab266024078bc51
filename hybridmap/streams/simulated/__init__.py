"""Simulated streams: rendered worlds with a drive, wheel odometry, an RGB-D camera and a planar laser."""

from hybridmap.streams.simulated.stream import SimulatedStream
from hybridmap.streams.simulated.worlds import world_names

__all__ = ["SimulatedStream", "world_names"]
