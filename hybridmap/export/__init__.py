"""Sessions for other tools: trajectories, graphs, clouds, grids."""

from hybridmap.export.formats import FORMATS, Exported, ExportOptions, export_session

__all__ = ["FORMATS", "ExportOptions", "Exported", "export_session"]
