"""The errors of hybridmap: one root class, and a subclass per stage.

The library raises them; only the command line turns an error into one line and exit code 2.
A message names the file, topic or field, what was found, what was expected and what to do.
"""

_MOST_QUOTED = 40


def quoted(found: object) -> str:
    """Quote a value found in a file, for a message: on one line, printable, and shortened if long."""
    text = " ".join(str(found).split())
    text = "".join(letter if letter.isprintable() and letter != "\ufffd" else "?" for letter in text)
    return f"'{text if len(text) <= _MOST_QUOTED else text[: _MOST_QUOTED - 3] + '...'}'"


def counted(count: float, noun: str) -> str:
    """A whole number of things in words: `1 loop`, `2 loops`; of a noun of several words the last one takes the s."""
    return f"{count:.0f} {noun}{'' if count == 1 else 's'}"


class HybridMapError(Exception):
    """Root of all errors that the user can do something about."""


class ConfigError(HybridMapError):
    """A configuration that cannot be used: unknown key, wrong type, value out of range."""


class StreamError(HybridMapError):
    """A source of sensor data that is missing, damaged, unordered or of the wrong kind."""


class RosError(HybridMapError):
    """A ROS that cannot be found or reached."""


class OutputError(HybridMapError):
    """A file or folder that cannot be written: it exists, is of another kind, is in use by another run, or is not writable."""


class GeometryError(HybridMapError):
    """An invalid pose, covariance or trajectory: wrong shape, NaN, not positive definite."""


class GraphError(HybridMapError):
    """An invalid graph: unknown node, edge from a node to itself, disconnected, no edges."""


class BackendError(HybridMapError):
    """A back-end that does not exist, or that refused or failed on a graph."""


class StoreError(HybridMapError):
    """A session folder or map file that is missing, damaged or of another version."""


class ExportError(HybridMapError):
    """An export that the session does not support."""


class PlanError(HybridMapError):
    """A way that cannot be planned: its ends are not in known free space, or no way between them is known."""


class EvaluationError(HybridMapError):
    """An evaluation or calibration that its data do not allow, or that was asked for in a wrong way."""


class StudyError(HybridMapError):
    """A study that cannot continue: its sources, its workers or its cluster."""


class LiveError(HybridMapError):
    """A live mapper that cannot go on: its process ended, or it does not answer."""
