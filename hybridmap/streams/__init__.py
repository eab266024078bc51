"""Sensor input: recordings and simulated drives as one kind of stream."""

from hybridmap.streams.open import open_stream

__all__ = ["open_stream"]
