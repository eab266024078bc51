"""Settings of the laser front-end."""

from __future__ import annotations

from hybridmap.config.section import Section


class LaserConfig(Section):
    """Submap registration and commitment by cluster."""
