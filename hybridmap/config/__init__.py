"""Every setting, one frozen section per stage. Command line overrides file, file overrides defaults. Results store them all."""

from hybridmap.config.root import Config, named_configs

__all__ = ["Config", "named_configs"]
