"""How arrays and sensor mountings become bytes and text, and back, without loss."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import SolveReport, SolveStatus
from hybridmap.errors import StoreError
from hybridmap.graph.edges import Check, Edge, Lack, Method, Need, Search
from hybridmap.store.schema import VERSION
from hybridmap.streams.base import Rig
from hybridmap.streams.sensors import kinds

_PNG_LEVEL = 1
_ZLIB_LEVEL = 1


@dataclass(frozen=True, slots=True)
class Packed:
    """An array as the map file keeps it: little-endian bytes (`zlib`) or an image (`png`)."""

    dtype: str
    shape: str
    codec: str
    data: bytes


def pack(array: NDArray[Any]) -> Packed:
    """Compress an array without loss; images of 8 or 16 bits become PNG, the rest zlib. Same array, same bytes."""
    little = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False))
    shape = json.dumps(list(array.shape))
    if _is_image(little):
        import cv2

        pixels = little[..., ::-1] if little.ndim == 3 else little
        _, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
        return Packed(little.dtype.str, shape, "png", data.tobytes())
    return Packed(little.dtype.str, shape, "zlib", zlib.compress(little.tobytes(), _ZLIB_LEVEL))


def unpack(packed: Packed) -> NDArray[Any]:
    """The array that was packed.

    Raises:
        StoreError: the bytes are damaged.
    """
    try:
        return _unpack(packed)
    except (zlib.error, ValueError, TypeError) as error:
        raise StoreError(f"map file: an array in it is damaged: {error}") from None


def _unpack(packed: Packed) -> NDArray[Any]:
    dtype, shape = np.dtype(packed.dtype), json.loads(packed.shape)
    if packed.codec == "png":
        import cv2

        pixels = cv2.imdecode(np.frombuffer(packed.data, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise ValueError("not an image")
        return np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels).reshape(shape)
    return np.frombuffer(zlib.decompress(packed.data), dtype).reshape(shape).copy()


def _is_image(array: NDArray[Any]) -> bool:
    grey_or_rgb = array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)
    return array.dtype.str in ("|u1", "<u2") and grey_or_rgb and min(array.shape) > 0


def pack_floats(values: NDArray[np.float64]) -> bytes:
    """Little-endian float64 bytes."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def unpack_floats(data: bytes, columns: int) -> NDArray[np.float64]:
    """The (-1, columns) float64 array that `pack_floats` wrote."""
    return np.frombuffer(data, "<f8").astype(np.float64).reshape(-1, columns)


def rig_to_json(rig: Rig) -> dict[str, Any]:
    """The sensors as plain values."""
    return {name: _plain(asdict(sensor)) for name, sensor in rig.sensors.items()}


def rig_from_json(tree: dict[str, Any]) -> Rig:
    """The sensors that `rig_to_json` gave; those of kinds that are not known here are left out."""
    types = {kind.sensor_name: kind.sensor for kind in kinds()}
    found = {name: fields for name, fields in tree.items() if fields is not None and name in types}
    return Rig(**{name: types[name](**{key: _array(value) for key, value in found[name].items()}) for name in found})


def _array(value: Any) -> Any:
    return np.array(value) if isinstance(value, list) else value


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    return {key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value for key, value in fields.items()}


def record_to_json(edge: Edge) -> str:
    """The record of the decision about an edge as one JSON object; what says nothing is left out."""
    fields = {
        "checks": [_row(check) for check in edge.checks],
        "lack": edge.lack,
        "method": edge.method,
        "search": edge.search,
        "figures": {name: float(value) for name, value in edge.figures.items()},
        "shift": edge.shift,
        "carried_m": edge.carried_m,
        "broken_by": [_row(check) for check in edge.broken_by],
        "contradicts_odometry": edge.contradicts_odometry,
    }
    return json.dumps({name: value for name, value in fields.items() if value})


def record_from_json(text: str, version: int = VERSION) -> dict[str, Any]:
    """The fields of an edge that `record_to_json` wrote; a file before version 3 has figures alone."""
    fields: dict[str, Any] = json.loads(text)
    if version < 3:
        carried_m = fields.pop("carried_m", None)
        return {"figures": fields, "carried_m": carried_m}
    for name in ("checks", "broken_by"):
        fields[name] = tuple(Check(figure, value, Need(needs), *limit) for figure, value, needs, *limit in fields.get(name, ()))
    for name, kind in (("lack", Lack), ("method", Method), ("search", Search)):
        if name in fields:
            fields[name] = kind(fields[name])
    return fields


def _row(check: Check) -> list[Any]:
    return [check.figure, check.value, check.needs, check.limit, check.setting]


def report_to_json(report: SolveReport) -> str:
    """A solver's report as one JSON object."""
    fields = asdict(report)
    fields["status"] = str(report.status)
    for name in ("rejected_edge_ids", "inconsistent_edge_ids"):
        fields[name] = [int(number) for number in fields[name]]
    for name in ("weights", "weak_edges"):
        fields[name] = {str(number): float(weight) for number, weight in fields[name].items()}
    return json.dumps(_plain(fields))


def report_from_json(text: str) -> SolveReport:
    """The report that `report_to_json` wrote."""
    fields = json.loads(text)
    fields["status"] = SolveStatus(fields["status"])
    for name in ("rejected_edge_ids", "inconsistent_edge_ids"):
        fields[name] = tuple(fields.get(name, ()))
    for name in ("weights", "weak_edges"):
        fields[name] = {int(number): weight for number, weight in fields.get(name, {}).items()}
    fields["rejected_clusters"] = tuple(tuple(cluster) for cluster in fields.get("rejected_clusters", ()))
    return SolveReport(**fields)
