"""The session on disk: the map file and the folder around it."""

from hybridmap.store.map_store import MapStore
from hybridmap.store.session_folder import MetricsFile, SessionFolder
from hybridmap.store.track import Track, trajectory_of

__all__ = ["MapStore", "MetricsFile", "SessionFolder", "Track", "trajectory_of"]
