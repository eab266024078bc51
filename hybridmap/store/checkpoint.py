"""The state of a run in a file, from which it can be gone on with after a kill or an error.

The file is a line that says what the state is good for, and the pickled state. Only our own classes and plain values are
unpickled (`_Reader.find_class`); settings and the map file are referred to and put in by the reader.
"""

from __future__ import annotations

import io
import itertools
import json
import pickle
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StoreError
from hybridmap.output import write_bytes

_MAGIC = "hybridmap checkpoint"
_FEW_BYTES = 1 << 14
"""Arrays below this size are written as they are."""
_OURS = (
    "hybridmap.backends",
    "hybridmap.calibration",
    "hybridmap.checkpoints",
    "hybridmap.config",
    "hybridmap.edge_book",
    "hybridmap.geometry",
    "hybridmap.graph",
    "hybridmap.mapper",
    "hybridmap.metrics",
    "hybridmap.motion_edges",
    "hybridmap.neural",
    "hybridmap.odometry_model",
    "hybridmap.ratslam",
    "hybridmap.recorder",
    "hybridmap.second_look",
    "hybridmap.store.tables",
    "hybridmap.streams",
    "hybridmap.trajectory",
    "hybridmap.vision",
    "hybridmap.wheel_noise",
)
"""Modules and packages of ours whose classes may be in a state."""
_PLAIN = {
    "array": ("_array_reconstructor", "array"),
    "builtins": ("bytearray", "complex", "frozenset", "list", "object", "range", "set", "slice"),
    "collections": ("Counter", "OrderedDict", "defaultdict", "deque"),
    "itertools": ("count",),
    "functools": ("partial",),
    "numpy": ("dtype", "ndarray"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "numpy._core.numeric": ("_frombuffer",),
    "numpy.core.multiarray": ("_reconstruct", "scalar"),
    "numpy.core.numeric": ("_frombuffer",),
    "numpy.random._pcg64": ("PCG64",),
    "numpy.random._pickle": ("__bit_generator_ctor", "__generator_ctor"),
    "numpy.random.bit_generator": ("SeedSequence", "__pyx_unpickle_SeedSequence"),
}
"""Module -> names of others that may be in a state, beside numpy's types of numbers."""
_FUNCTIONS = {("hybridmap.backends.driver", "restored"), ("hybridmap.neural.grid", "relu")}
"""Functions of ours that a state may name."""
_METHODS = {(list, "__getitem__"), (itertools.count, "__next__")}
"""Methods of others that a state may hold."""


class UnusableError(StoreError):
    """A state that cannot be written or read: it holds what is not ours, or the file is missing or damaged."""


@dataclass(frozen=True, slots=True)
class Origin:
    """What a state was made from; with anything else it cannot be gone on with.

    Attributes:
        code: digest of hybridmap's code and of the libraries, for the state has their classes.
        version: version of hybridmap, for people.
        config: the resolved configuration, as YAML.
        source: name of what is mapped.
        expected: number of observations of the source; None if unknown.
        first_ns: stamps of the first samples, ns.
    """

    code: str
    version: str
    config: str
    source: str
    expected: int | None
    first_ns: tuple[int, ...]


def write(path: Path, origin: Origin, state: Any, known: Mapping[str, Any]) -> int:
    """Write a state atomically; returns the size of the file in bytes.

    Args:
        path: of the file.
        origin: what the state was made from.
        state: the object.
        known: name -> object that is referred to and not written.

    Raises:
        UnusableError: the state holds something that is not ours.
        OutputError: the file cannot be written.
    """
    buffer = io.BytesIO()
    try:
        _Writer(buffer, known).dump(state)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise UnusableError(f"{path}: the state cannot be written: {error}") from None
    content = buffer.getbuffer()
    head = json.dumps({"format": _MAGIC, "crc32": zlib.crc32(content), **asdict(origin)}) + "\n"
    whole = head.encode() + content
    write_bytes(path, whole)
    return len(whole)


def read_origin(path: Path) -> Origin:
    """What the state in a file was made from; the state itself is not read.

    Raises:
        UnusableError: there is no such file, or it is damaged.
    """
    return _head(path, _content(path).partition(b"\n")[0])[0]


def read(path: Path, known: Mapping[str, Any]) -> Any:
    """The state that `write` wrote, with the objects of `known` in their places.

    Raises:
        UnusableError: there is no such file, or it is damaged.
    """
    head, _, content = _content(path).partition(b"\n")
    _, crc32 = _head(path, head)
    if zlib.crc32(content) != crc32:
        raise UnusableError(f"{path}: damaged: the state is not what was written")
    try:
        return _Reader(io.BytesIO(content), known).load()
    except Exception as error:  # noqa: BLE001  # a damaged state may raise anything
        raise UnusableError(f"{path}: damaged: {error}") from None


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UnusableError(f"{path}: cannot be read: {error.strerror}") from None


def _head(path: Path, line: bytes) -> tuple[Origin, int]:
    try:
        fields = json.loads(line)
        if fields.pop("format") != _MAGIC:
            raise ValueError("another format")
        crc32 = int(fields.pop("crc32"))
        return Origin(**{**fields, "first_ns": tuple(fields["first_ns"])}), crc32
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        raise UnusableError(f"{path}: damaged: {error}") from None


class _Writer(pickle.Pickler):
    """Pickles a state; what the reader would refuse is refused here."""

    def __init__(self, file: io.BytesIO, known: Mapping[str, Any]) -> None:
        super().__init__(file, protocol=5)
        self._names = {id(value): name for name, value in known.items()}

    def persistent_id(self, obj: Any) -> Any:
        """The name of an object that the reader puts in."""
        return self._names.get(id(obj))

    def reducer_override(self, obj: Any) -> Any:
        """Write arrays so that they come back the same in memory: views share it with others, and have strides of their own.

        Arrays that end in equal rows, as those that are made large for what is to come do, are shortened.
        """
        if type(obj) is np.ndarray:
            whole = _whole(obj)
            return _shortened(obj) if whole is obj else _reduced(obj, whole)
        if isinstance(obj, itertools.count):
            return itertools.count, (int(repr(obj)[6:-1]),)
        if isinstance(obj, type):
            _require(obj.__module__, obj.__qualname__)
        return NotImplemented


class _Reader(pickle.Unpickler):
    """Unpickles a state, which may hold nothing but what `find_class` knows."""

    def __init__(self, file: io.BytesIO, known: Mapping[str, Any]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, pid: Any) -> Any:
        """The object of a name."""
        return self._known[pid]

    def find_class(self, module: str, name: str) -> Any:
        """A class or function that a state may hold."""
        if (module, name) == ("builtins", "getattr"):
            return _method
        _require(module, name)
        if module == __name__:
            return _RESTORING[name]
        found = super().find_class(module, name)
        if module.startswith("hybridmap.") and not isinstance(found, type) and (module, name) not in _FUNCTIONS:
            raise pickle.UnpicklingError(f"{module}.{name} is no class")
        return found


def _require(module: str, name: str) -> None:
    ours = any(module == known or module.startswith(f"{known}.") for known in _OURS)
    number = module in ("numpy", "numpy.dtypes") and (name.endswith("DType") or name.rstrip("0123456789") in _NUMBERS)
    if not (
        ours
        or (module == __name__ and name in _RESTORING)
        or number
        or name in _PLAIN.get(module, ())
        or (module, name) in _FUNCTIONS
    ):
        raise pickle.PicklingError(f"{module}.{name} is not among what a state may hold")


_NUMBERS = ("float", "int", "uint", "complex", "bool", "bool_")


def _method(owner: Any, name: str) -> Any:
    """A method that an object of ours is called by; stands for `getattr` in a state."""
    if (type(owner), name) in _METHODS or type(owner).__module__.startswith(_OURS):
        return getattr(owner, name)
    raise pickle.UnpicklingError(f"{type(owner).__name__}.{name} is not among what a state may hold")


def _whole(array: NDArray[Any]) -> NDArray[Any]:
    """The array that an array is a view of; itself if it is none, or if no elements are in it."""
    whole = _owner(array)
    single = type(whole) is np.ndarray and (whole.flags.c_contiguous or whole.flags.f_contiguous)
    return whole if array.size and single and not whole.dtype.hasobject else array


def _owner(array: NDArray[Any]) -> NDArray[Any]:
    base: Any = array.base
    if base is not None and not isinstance(base, np.ndarray):
        base = getattr(base, "base", None)  # `as_strided` puts an object of its own between a view and its array
    return _owner(base) if isinstance(base, np.ndarray) else array


def _reduced(array: NDArray[Any], whole: NDArray[Any]) -> Any:
    """How to pickle a view."""
    offset = array.__array_interface__["data"][0] - whole.__array_interface__["data"][0]
    return _view, (whole, array.dtype, array.shape, offset, array.strides, array.flags.writeable)


def _view(
    whole: NDArray[Any], dtype: Any, shape: tuple[int, ...], offset: int, strides: tuple[int, ...], writeable: bool
) -> NDArray[Any]:
    """The view that `_reduced` wrote."""
    memory = whole if whole.flags.c_contiguous else whole.T
    out: NDArray[Any] = np.ndarray(shape, dtype, memory, offset, strides)
    out.flags.writeable = writeable
    return out


def _shortened(array: NDArray[Any]) -> Any:
    """How to pickle an array: without the last rows that are all the same, if they are many."""
    if array.nbytes < _FEW_BYTES or array.ndim < 1 or array.dtype.hasobject or not array.flags.c_contiguous or len(array) < 4:
        return NotImplemented
    rows = array.reshape(-1).view(np.uint8).reshape(len(array), -1)
    if not np.array_equal(rows[len(rows) // 2], rows[-1]) or not np.array_equal(rows[-2], rows[-1]):
        return NotImplemented
    differs = np.flatnonzero((rows != rows[-1]).any(axis=1))
    length = int(differs[-1]) + 2 if len(differs) else 1
    return (_lengthened, (array[:length].copy(), len(array))) if length < len(array) else NotImplemented


def _lengthened(array: NDArray[Any], length: int) -> NDArray[Any]:
    """The array that `_shortened` wrote."""
    out = np.empty((length, *array.shape[1:]), dtype=array.dtype)
    out[: len(array)] = array
    out[len(array) :] = array[-1]
    return out


_RESTORING: dict[str, Callable[..., NDArray[Any]]] = {"_view": _view, "_lengthened": _lengthened}
"""Functions of this module that a state may name."""
