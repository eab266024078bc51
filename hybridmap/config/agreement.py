"""When sightings of a lost robot agree well enough to be believed."""

from __future__ import annotations

from pydantic import Field

from hybridmap.config.section import Section


class AgreementConfig(Section):
    """Sightings wait until several of them, over some travel, put the robot at one and the same place."""

    support: int = Field(default=4, ge=2)
    """Nodes whose closures must put the robot at one and the same place."""
    span_m: float = Field(default=0.75, ge=0)
    """Travel that they must cover, m; more where they fit badly (`mismatch_max`)."""
    mismatch_max: float = Field(default=0.15, gt=0)
    """Mean mismatch, of sightings that say how badly they fit, at which no travel is enough; half of it doubles `span_m`."""
    mismatch_scale: float = Field(default=0.03, gt=0)
    """Of one node's sightings at different places, one that fits worse by this counts for a factor e less."""
    wait_m: float = Field(default=32.0, gt=0)
    """Travel after which a sighting that no others agreed with is given up, m."""
