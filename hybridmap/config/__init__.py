"""Every setting, one frozen section per processing stage.

The command line overrides the configuration file, the file overrides the defaults. Results store the whole configuration.
"""

from hybridmap.config.root import Config, named_configs

__all__ = ["Config", "named_configs"]
