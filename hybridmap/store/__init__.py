"""The session on disk: the map file and the folder around it."""

from hybridmap.store.map_store import MapStore
from hybridmap.store.session_folder import MetricsFile, SessionFolder
from hybridmap.store.track import Anchors, Track, anchors_on, trajectory_of

__all__ = ["Anchors", "MapStore", "MetricsFile", "SessionFolder", "Track", "anchors_on", "trajectory_of"]
