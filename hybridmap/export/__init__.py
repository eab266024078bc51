"""Sessions for other tools: trajectories, graphs, clouds, grids."""

from hybridmap.export.formats import FORMATS, Exported, export_session
from hybridmap.export.view import ExportOptions

__all__ = ["FORMATS", "ExportOptions", "Exported", "export_session"]
