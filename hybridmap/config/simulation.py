"""Settings of the simulated worlds and drives."""

from __future__ import annotations

from hybridmap.config.section import Section


class SimulationConfig(Section):
    """World, drive, sensors and their noise."""
