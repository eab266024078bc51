"""Messages of ROS 2 as bytes, and the classes that rclpy wants for a topic of them.

Bytes are made by the code that reads bags, so that a message type needs no package of ROS here. rclpy still wants a class
with the type's C code. Where no package has one, as for `/tf` among the wheels of PyPI, which have no `tf2_msgs`, the C code of
another message is borrowed under the type's name: bytes pass through it untouched.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from hybridmap.errors import RosError
from hybridmap.ros.contents import Contents, Stamp
from hybridmap.streams.messages import standard_store

_FASTRTPS = b"rosidl_typesupport_fastrtps_c"
_HANDLE_WORDS = 6  # of rosidl_message_type_support_t: identifier, data, function, and three on the type's description
_CALLBACK_WORDS = 7  # of message_type_support_callbacks_t: namespace, name, functions
_WORD = ctypes.c_void_p
_NUMBERS = {"bool": False, "string": "", "float32": 0.0, "float64": 0.0}


def serialised(msgtype: str, contents: Contents) -> bytes:
    """The CDR bytes of a message with these fields; others are zero or empty.

    Args:
        msgtype: full name, such as `nav_msgs/msg/Path`.
        contents: its fields.
    """
    return bytes(standard_store(is_ros1=False).serialize_cdr(_message(msgtype, contents), msgtype))


def _message(msgtype: str, contents: Contents | Stamp) -> Any:
    store = standard_store(is_ros1=False)
    if isinstance(contents, Stamp):
        return store.types[msgtype](*contents.parts)
    _, fields = store.fielddefs[msgtype]
    return store.types[msgtype](*(_field(contents.get(name), kind, of) for name, (kind, of) in fields))


def _field(value: Any, kind: Any, of: Any) -> Any:
    """A field, or its zero, as `rosbags` wants it."""
    from rosbags.interfaces import Nodetype

    if kind == Nodetype.BASE:
        return _NUMBERS.get(of[0], 0) if value is None else value
    if kind == Nodetype.NAME:
        return _message(of, {} if value is None else value)
    (element_kind, element), length = of
    given = [] if value is None else value
    if element_kind == Nodetype.NAME:
        return [_message(element, one) for one in given]
    if element[0] == "string":
        return list(given)
    return np.asarray(given if len(given) else np.zeros(length), dtype=np.dtype("u1" if element[0] == "byte" else element[0]))


def filled(message: Any, contents: Contents) -> Any:
    """A message object of rclpy with these fields, for services; a list of messages is not provided for."""
    for name, value in contents.items():
        if isinstance(value, Stamp):
            now = getattr(message, name)
            now.sec, now.nanosec = value.parts
        elif isinstance(value, Mapping):
            filled(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


def endpoint(create: Callable[..., Any], msgtype: str, *arguments: Any, **named: Any) -> Any:
    """A publisher or subscription of bytes, made by a method of a node of rclpy with the class of a message type.

    Raises:
        RosError: no package has the type, and it cannot be borrowed either.
    """
    made = create(_message_class(msgtype), *arguments, **named)
    with suppress(OSError):  # borrowed code has no description, which is noted as an error for the next call to stumble over
        ctypes.CDLL("librcutils.so").rcutils_reset_error()
    return made


@cache
def _message_class(msgtype: str) -> Any:
    """The class of a message type.

    Raises:
        RosError: no package has it, and it cannot be borrowed either.
    """
    package, _, name = msgtype.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        missing = error
    if msgtype in standard_store(is_ros1=False).fielddefs:
        borrowed = borrowed_class(msgtype)
        if borrowed is not None:
            return borrowed
    raise RosError(f"ROS 2 has no message type {msgtype} here ({missing}): install the package {package}")


def borrowed_class(msgtype: str) -> Any:
    """A class with the C code of a TransformStamped under another name; None unless the middleware is Fast DDS."""
    package, _, name = msgtype.split("/")
    import rclpy
    from geometry_msgs.msg import TransformStamped

    if rclpy.get_rmw_implementation_identifier() != "rmw_fastrtps_cpp":
        return None
    lender = type(TransformStamped)
    lender.__import_type_support__()
    python = ctypes.pythonapi
    python.PyCapsule_GetPointer.restype, python.PyCapsule_GetPointer.argtypes = _WORD, [ctypes.py_object, ctypes.c_char_p]
    python.PyCapsule_New.restype, python.PyCapsule_New.argtypes = ctypes.py_object, [_WORD, ctypes.c_char_p, _WORD]
    outer = python.PyCapsule_GetPointer(lender._TYPE_SUPPORT, None)
    find = ctypes.CFUNCTYPE(_WORD, _WORD, ctypes.c_char_p)(_words(outer, _HANDLE_WORDS)[2])
    inner = find(outer, _FASTRTPS)
    if inner is None:
        return None
    handle = _words(inner, _HANDLE_WORDS)
    callbacks = _words(handle[1], _CALLBACK_WORDS)
    names = ctypes.create_string_buffer(f"{package}::msg".encode()), ctypes.create_string_buffer(name.encode())
    callbacks[0], callbacks[1] = (ctypes.addressof(one) for one in names)
    version, _, digest = standard_store(is_ros1=False).hash_rihs01(msgtype).removeprefix("RIHS").partition("_")
    type_hash = ctypes.create_string_buffer(bytes([int(version)]) + bytes.fromhex(digest), 33)
    hashed = ctypes.CFUNCTYPE(_WORD, _WORD)(lambda _: ctypes.addressof(type_hash))
    handle[1], handle[3] = ctypes.addressof(callbacks), ctypes.cast(hashed, _WORD).value
    capsule = python.PyCapsule_New(ctypes.addressof(handle), None, None)
    lent = {part: getattr(lender, part) for part in ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY")}
    own = {
        "_TYPE_SUPPORT": capsule,
        "_DESTROY_ROS_MESSAGE": lender._DESTROY_ROS_MESSAGE,
        "__import_type_support__": staticmethod(lambda: None),
    }
    meta = type(f"Metaclass_{name}", (type,), lent | own)
    return meta(name, (), {"_kept": (handle, callbacks, names, type_hash, hashed), "__slots__": ()})


def _words(address: int | None, number: int) -> Any:
    """A copy of the words at an address."""
    return (_WORD * number)(*(_WORD * number).from_address(address or 0))
