"""Pickling of a state of ours: fast, with arrays as they lie in memory, and nothing but what `Reader.find_class` knows."""

from __future__ import annotations

import io
import itertools
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    "hybridmap.known_places",
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


_UNCHANGING = {
    "hybridmap.graph.edges.Edge",
    "hybridmap.graph.experience_map.Node",
    "hybridmap.streams.laser.LaserScan",
    "hybridmap.streams.rgbd.RgbdFrame",
    "hybridmap.vision.laser.cloud.Cloud",
    "hybridmap.vision.laser.dense_trajectory.ObservedScan",
    "hybridmap.vision.rgbd.keyframe.Keyframe",
    "hybridmap.vision.rgbd.keyframe.WorkingImage",
}
"""Classes of which there are many objects, that never change, nor do their arrays."""


class Numbered:
    """Objects of a state that never change, such as scans, by number: a file has the first of them."""

    def __init__(self) -> None:
        """Begin without any."""
        self._objects: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._written = 0

    def keep(self, parts: Sequence[Any]) -> None:
        """Take in objects that the file has."""
        for part in parts:
            self.number(part)
        self.note_written()

    def __getitem__(self, number: int) -> Any:
        return self._objects[number]

    def number(self, part: Any) -> int:
        """The number of an object, which waits to be written if it is new."""
        found = self._numbers.setdefault(id(part), len(self._objects))
        if found == len(self._objects):
            self._objects.append(part)
        return found

    def written(self, part: Any) -> int | None:
        """The number of an object that the file has; None if it has not."""
        found = self._numbers.get(id(part))
        return found if found is not None and found < self._written else None

    @property
    def new(self) -> list[Any]:
        """The objects that the file has not."""
        return self._objects[self._written :]

    def note_written(self) -> None:
        """From now on the file has all objects."""
        self._written = len(self._objects)


@cache
def _never_changes(kind: Any) -> bool:
    return f"{kind.__module__}.{kind.__name__}" in _UNCHANGING


class Writer(pickle.Pickler):
    """Pickles a state; what the reader would refuse is refused here.

    `names` are those of the objects that the reader puts in, by id.
    """

    def __init__(self, file: io.BytesIO, names: Mapping[int, str], parts: Numbered) -> None:
        super().__init__(file, protocol=5)
        self._parts, self._names = parts, names

    def reducer_override(self, obj: Any) -> Any:
        """Write arrays so that they come back the same in memory: views share it with others, and have strides of their own.

        Arrays that end in equal rows, as those that are made large for what is to come do, are shortened.
        """
        kind: Any = type(obj)
        if kind is np.ndarray:
            return _array(obj)
        if id(obj) in self._names:
            return _known, (self._names[id(obj)],)
        if _never_changes(kind):
            return self._part(obj)
        if kind is itertools.count:
            return itertools.count, (int(repr(obj)[6:-1]),)
        if isinstance(obj, type):
            _require(obj.__module__, obj.__qualname__)
        return NotImplemented

    def _part(self, obj: Any) -> Any:
        return _part, (self._parts.number(obj),)


class PartWriter(Writer):
    """Pickles unchanging objects, with copies of their arrays: nobody writes to these."""

    def reducer_override(self, obj: Any) -> Any:
        """See `Writer`; arrays without gaps are copied, and the fields of frozen dataclasses written one by one."""
        kind: Any = type(obj)
        if kind is np.ndarray and obj.flags.c_contiguous:
            return NotImplemented
        number = self._parts.written(obj)
        if number is not None:
            return _part, (number,)
        names = _slots(kind)
        if names:
            _require(kind.__module__, kind.__qualname__)
            return _made, (kind, *[getattr(obj, name) for name in names])
        return super().reducer_override(obj)


@cache
def _slots(kind: Any) -> tuple[str, ...]:
    """Names of the fields of a frozen dataclass with slots; empty for other classes."""
    params = getattr(kind, "__dataclass_params__", None)
    frozen = params is not None and params.frozen and kind.__dictoffset__ == 0
    return tuple(one.name for one in fields(kind)) if frozen else ()


def _made(kind: type, *values: Any) -> Any:
    """The object of a frozen dataclass with these fields."""
    made: Any = object.__new__(kind)
    for name, value in zip(_slots(kind), values, strict=True):
        object.__setattr__(made, name, value)
    return made


class Reader(pickle.Unpickler):
    """Unpickles a state, which may hold nothing but what `find_class` knows."""

    def __init__(self, file: io.BytesIO, known: Mapping[str, Any], parts: Numbered) -> None:
        super().__init__(file)
        self._standing = {"_known": known.__getitem__, "_part": parts.__getitem__}

    def find_class(self, module: str, name: str) -> Any:
        """A class or function that a state may hold."""
        if (module, name) == ("builtins", "getattr"):
            return _method
        _require(module, name)
        if module == __name__:
            return self._standing.get(name) or _RESTORING[name]
        found = super().find_class(module, name)
        if module.startswith("hybridmap.") and not isinstance(found, type) and (module, name) not in _FUNCTIONS:
            raise pickle.UnpicklingError(f"{module}.{name} is no class")
        return found


@cache
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


def _array(array: NDArray[Any]) -> Any:
    """How to pickle an array."""
    if array.base is not None:
        whole = _whole(array)
        if whole is not array:
            return _reduced(array, whole)
    return _shortened(array) if array.nbytes >= _FEW_BYTES else NotImplemented


def _shortened(array: NDArray[Any]) -> Any:
    """How to pickle an array: without the last rows that are all the same, if they are many."""
    if array.ndim < 2 or array.dtype.hasobject or not array.flags.c_contiguous or len(array) < 4:
        return NotImplemented
    unit = np.uint64 if array.nbytes // len(array) % 8 == 0 else np.uint8
    rows = array.reshape(-1).view(unit).reshape(len(array), -1)
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


def _known(name: str) -> Any:
    """Stands in a state for what the reader puts in."""
    raise LookupError(name)


def _part(number: int) -> Any:
    """Stands in a state for an unchanging part."""
    raise LookupError(number)


_RESTORING: dict[str, Callable[..., Any]] = {
    "_view": _view,
    "_lengthened": _lengthened,
    "_known": _known,
    "_part": _part,
    "_made": _made,
}
"""Functions of this module that a state may name."""
