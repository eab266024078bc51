"""Settings of the RGB-D front-end."""

from __future__ import annotations

from hybridmap.config.section import Section


class RgbdConfig(Section):
    """Scanline profiles, features, depth registration."""
