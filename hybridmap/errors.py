"""The tree of errors: one root, a subclass a stage.

Library code raises these; only the command line turns one into a line and exit code 2.
A message names the file, topic or field, what was found, what was expected and what to do.
"""


class HybridMapError(Exception):
    """Root of every error that the user can do something about."""


class ConfigError(HybridMapError):
    """A configuration that cannot be used: unknown key, wrong type, value out of range."""


class StreamError(HybridMapError):
    """A source of sensor data that is missing, damaged, unordered or of the wrong kind."""


class OutputError(HybridMapError):
    """A file or folder that cannot be written: taken, of another kind, being written by another run, or out of reach."""


class GeometryError(HybridMapError):
    """A pose, covariance or trajectory that is not one: wrong shape, NaN, not positive definite."""


class GraphError(HybridMapError):
    """A graph that contradicts itself: unknown node, edge onto itself, disconnected, no edges."""


class BackendError(HybridMapError):
    """A solver that does not exist, or that refused or failed on a graph."""


class StoreError(HybridMapError):
    """A session folder or map file that is missing, damaged or of another version."""


class ExportError(HybridMapError):
    """An export that the session cannot give."""


class EvaluationError(HybridMapError):
    """A comparison without enough common data."""


class StudyError(HybridMapError):
    """A study that cannot go on: its sources, its workers or its cluster."""
