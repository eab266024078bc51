"""Settings of the streams: topics, mounting, synchronisation."""

from __future__ import annotations

from hybridmap.config.section import Section


class SensorsConfig(Section):
    """Where the sensor data come from; None means: find it."""
