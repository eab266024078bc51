"""Every setting: one frozen section a stage. Command line > file > defaults; the resolved file is saved with each result."""

from hybridmap.config.root import Config, named_configs

__all__ = ["Config", "named_configs"]
