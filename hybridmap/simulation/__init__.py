"""The simulator: rendered worlds with a drive, wheel odometry, an RGB-D camera and a planar laser."""

from hybridmap.simulation.stream import SimulatedStream
from hybridmap.simulation.worlds import world_names

__all__ = ["SimulatedStream", "world_names"]
