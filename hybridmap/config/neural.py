"""Settings of the spatial cells."""

from __future__ import annotations

from hybridmap.config.section import Section


class NeuralConfig(Section):
    """The path integrator."""
