"""Settings of the back-ends."""

from __future__ import annotations

from pydantic import Field

from hybridmap.config.section import Section


class BackendsConfig(Section):
    """Which back-ends follow the graph; the first is the primary and drives `map -> odom`."""

    names: tuple[str, ...] = Field(default=("gtsam-gnc", "relaxation-ratslam"), min_length=1)
    """Names; the first is the primary."""
