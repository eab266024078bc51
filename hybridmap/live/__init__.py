"""Mapping on a robot while it drives: a mapper in a process of its own, which takes samples at once and in any order.

`LiveMapper` is what a robot's program uses.
"""

from hybridmap.live.drive import LiveReport
from hybridmap.live.inbox import LiveLimits
from hybridmap.live.mapper import LiveMapper
from hybridmap.live.messages import Snapshot
from hybridmap.live.odometry import SmoothedCorrection
from hybridmap.live.process import MappingProcess

__all__ = ["LiveLimits", "LiveMapper", "LiveReport", "MappingProcess", "SmoothedCorrection", "Snapshot"]
