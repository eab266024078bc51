"""A frozen graph with its reference, and with the figures of the drive that it comes from."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_ARRAYS = tuple(one.name for one in fields(PoseGraph) if one.name != "file")
_POSES_OF = "poses of "
Figures = Mapping[str, float | None]


@dataclass(frozen=True, slots=True)
class Mapped:
    """The figures of a drive as it was mapped.

    Attributes:
        primary: name of the back-end whose map the mapper used.
        figures: name of a back-end (or `odometry`) -> its figures, named as in `measures.MAPPED`.
        timings: name -> value, for the names in `measures.TIMINGS`.
        poses: name of a back-end (or `odometry`) -> (N, 3) poses of the nodes in its map of the drive, m and rad.
        lost: name of a back-end that ended without a map of its own -> its status (`SolveStatus`), and why in one line.
    """

    primary: str
    figures: Mapping[str, Figures]
    timings: Mapping[str, float]
    poses: Mapping[str, Array]
    lost: Mapping[str, tuple[str, str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Frozen:
    """A frozen graph with its reference poses.

    Attributes:
        graph: the clean graph, without added false loops or drift; None if it could not be made.
        reference: (N, 3) reference pose of each node, m and rad; NaN where unknown.
        of_truth: True: the reference is ground truth; False: it is the optimum of the clean graph by `gtsam-lm`, or NaN where
            that is not computed or was not found.
        failure: why there is no graph; empty string if there is one.
        mapped: figures of the drive that the graph comes from; None if it does not come from a drive.
    """

    graph: PoseGraph | None
    reference: Array
    of_truth: bool = False
    failure: str = ""
    mapped: Mapped | None = None

    def pack(self) -> bytes:
        """Serialise to bytes that `unpack` reads; equal content gives equal bytes."""
        arrays: dict[str, Any] = {"reference": self.reference, "of_truth": self.of_truth, "failure": self.failure}
        if self.graph is not None:
            given = {name: getattr(self.graph, name) for name in _ARRAYS}
            arrays |= {name: array for name, array in given.items() if array is not None}
        if self.mapped is not None:
            told = [self.mapped.primary, self.mapped.figures, self.mapped.timings, self.mapped.lost]
            arrays["mapped"] = json.dumps(told, allow_nan=False)
            arrays |= {_POSES_OF + name: poses for name, poses in self.mapped.poses.items()}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        return buffer.getvalue()

    @classmethod
    def unpack(cls, data: bytes) -> Frozen:
        """Read the bytes written by `pack`.

        Raises:
            ValueError, OSError, KeyError, zipfile.BadZipFile: the bytes are damaged.
        """
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            given = {name: arrays[name] for name in _ARRAYS if name in arrays}
            poses = {name.removeprefix(_POSES_OF): arrays[name] for name in arrays if name.startswith(_POSES_OF)}
            mapped = None
            if "mapped" in arrays:
                primary, figures, timings, lost = json.loads(str(arrays["mapped"]))
                ends = {name: (status, why) for name, (status, why) in lost.items()}
                mapped = Mapped(primary, figures, timings, poses, ends)
            graph = PoseGraph(**given) if given else None
            return cls(graph, arrays["reference"], bool(arrays["of_truth"]), str(arrays["failure"]), mapped)
