"""Settings of the experience map itself: when a node is made, how sure its edges are."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hybridmap.config.section import Section


class NodesConfig(Section):
    """Novelty: a node is made when one of the rules says so."""

    rule: Literal["travel", "novelty"] = "travel"
    """`travel`: every so many metres or degrees; `novelty`: the paper's, by place code and view template."""
    distance_m: float = Field(default=0.25, gt=0)
    """`travel`: metres since the last node."""
    angle_deg: float = Field(default=15.0, gt=0, le=180)
    """`travel`: degrees turned since the last node."""
    place_threshold: float = Field(default=0.4, gt=0, le=1)
    """`novelty`: S_th, the least distance (1 - cosine) of the place code to that of every node."""


class EdgesConfig(Section):
    """Odometry edges, and how a closure enters the map."""

    hanging: Literal["chain", "ratslam"] = "chain"
    """`chain` keeps consecutive nodes joined and adds a loop edge; `ratslam` re-hangs the next node on the matched one, as
    OpenRatSLAM does (a baseline: one false match breaks the chain)."""
    gate: Literal["map", "odometry"] = "map"
    """Whose poses gate closures: the primary back-end's, or the integrator's alone (the graph owes nothing to a back-end)."""
    drop_contradicted: bool = True
    """Drop an odometry edge that a good registration of the same two nodes contradicts."""
    translation_floor_m: float = Field(default=0.005, gt=0)
    """Standard deviation of an odometry edge at no travel, m."""
    rotation_floor_deg: float = Field(default=0.2, gt=0)
    """Standard deviation of an odometry edge at no travel, degrees."""
    translation_per_sqrt_m: float = Field(default=0.02, ge=0)
    """Growth of the translation's standard deviation, m per sqrt(m) of travel."""
    rotation_deg_per_sqrt_m: float = Field(default=0.6, ge=0)
    """Growth of the heading's standard deviation, degrees per sqrt(m) of travel."""
    rotation_per_turn: float = Field(default=0.02, ge=0)
    """Growth of the heading's standard deviation, radians per sqrt(radian) turned."""
