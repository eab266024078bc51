"""A frozen graph with its reference, and with the figures of the drive that it comes from."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_ARRAYS = tuple(one.name for one in fields(PoseGraph) if one.name != "file")
Figures = Mapping[str, float | None]


@dataclass(frozen=True, slots=True)
class Mapped:
    """The figures of a drive as it was mapped.

    Attributes:
        primary: the primary back-end.
        figures: back-end (or `odometry`) -> figures of `measures.MAPPED`.
        timings: figures of `measures.TIMINGS`.
    """

    primary: str
    figures: Mapping[str, Figures]
    timings: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Frozen:
    """A frozen graph with its reference.

    Attributes:
        graph: without false loops or drift; None if it could not be made.
        reference: (N, 3) m and rad, NaN where unknown.
        of_truth: whether the reference is ground truth; else it is the optimum of the clean graph by `gtsam-lm`.
        failure: why there is no graph; empty otherwise.
        mapped: of the drive that the graph comes from; None if it comes from no drive.
    """

    graph: PoseGraph | None
    reference: Array
    of_truth: bool = False
    failure: str = ""
    mapped: Mapped | None = None

    def pack(self) -> bytes:
        """As bytes that `unpack` reads; the same content gives the same bytes."""
        arrays: dict[str, Any] = {"reference": self.reference, "of_truth": self.of_truth, "failure": self.failure}
        if self.graph is not None:
            given = {name: getattr(self.graph, name) for name in _ARRAYS}
            arrays |= {name: array for name, array in given.items() if array is not None}
        if self.mapped is not None:
            arrays["mapped"] = json.dumps([self.mapped.primary, self.mapped.figures, self.mapped.timings], allow_nan=False)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        return buffer.getvalue()

    @classmethod
    def unpack(cls, data: bytes) -> Frozen:
        """Read the bytes of `pack`.

        Raises:
            ValueError, OSError, KeyError, zipfile.BadZipFile: it is damaged.
        """
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            given = {name: arrays[name] for name in _ARRAYS if name in arrays}
            mapped = Mapped(*json.loads(str(arrays["mapped"]))) if "mapped" in arrays else None
            graph = PoseGraph(**given) if given else None
            return cls(graph, arrays["reference"], bool(arrays["of_truth"]), str(arrays["failure"]), mapped)
