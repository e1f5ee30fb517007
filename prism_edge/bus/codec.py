"""Internal messages as bytes: any dataclass of numbers, strings and arrays, read back without a copy.

Layout, little endian::

    0   4s   b"PRSM"
    4   u16  version of this layout
    6   u16  number of float fields F
    8   u32  header length H in bytes
    12  u32  0
    16       F float64: the float fields in order (they may be NaN or infinite, which JSON can't say)
    ..  H    JSON: [type name, [values of the other plain fields], [[dtype, dimension, ...] of each array]]
    ..       the arrays, C order; header and each array are padded with zeros to a multiple of 8

The field types come from the dataclass itself, dtype and shape of an array from its metadata
(:func:`prism_edge.messages.array`). Unpacking trusts nothing: any defect is a :class:`BusError`.
"""

from __future__ import annotations

import json
import operator
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from math import prod
from typing import Any, TypeVar, get_type_hints

import numpy as np

from prism_edge.errors import BusError

Message = TypeVar("Message")

MAGIC = b"PRSM"
VERSION = 1
MAX_HEADER = 64 * 1024

_PREFIX = struct.Struct("<4sHHII")
_PADDING = [b"\0" * n for n in range(8)]
_INT64 = range(-(2**63), 2**63)
_encode = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


def _refuse_constant(word: str) -> Any:
    raise ValueError(f"{word} in the header")


_decode = json.JSONDecoder(parse_constant=_refuse_constant).decode


@dataclass(frozen=True)
class _Plain:
    name: str
    kind: type  # int, bool, str or dict

    def outgoing(self, value: Any) -> Any:
        """The value as JSON takes it; NumPy scalars become Python's, halves of characters question marks."""
        if self.kind is str:
            value = _writable(value)
        elif self.kind is dict and isinstance(value, dict):
            value = {_writable(k): _writable(v) for k, v in value.items()}
        elif self.kind is int:
            value = operator.index(value)
        elif self.kind is bool and isinstance(value, np.bool_):
            value = bool(value)
        if not self.accepts(value):
            raise TypeError(f"is {value!r:.40}")
        return value

    def accepts(self, value: Any) -> bool:
        if type(value) is not self.kind:
            return False
        if isinstance(value, dict):
            return all(_is_text(word) for pair in value.items() for word in pair)
        if self.kind is str:
            return _is_text(value)
        return self.kind is not int or value in _INT64


def _writable(value: Any) -> Any:
    plain = not isinstance(value, str) or value.isascii()
    return value if plain else value.encode("utf-8", "replace").decode()


def _is_text(value: Any) -> bool:
    """Whether it is text that can be written: JSON has halves of characters, which nothing else takes."""
    return type(value) is str and _writable(value) == value


@dataclass(frozen=True)
class _Array:
    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    def fits(self, shape: Any) -> bool:
        return len(shape) == len(self.shape) and all(
            want in (-1, have) for want, have in zip(self.shape, shape, strict=True)
        )


@dataclass(frozen=True)
class _Plan:
    """The fields of one dataclass by kind, worked out once."""

    floats: tuple[str, ...]
    pack_floats: Callable[..., bytes]
    unpack_floats: Callable[..., tuple[float, ...]]
    plain: tuple[_Plain, ...]
    arrays: tuple[_Array, ...]


_plans: dict[type, _Plan] = {}


def _plan(cls: type) -> _Plan:
    if cls not in _plans:
        _plans[cls] = _make_plan(cls)
    return _plans[cls]


def _make_plan(cls: Any) -> _Plan:
    hints = get_type_hints(cls)
    floats, plain, arrays = [], [], []
    for f in fields(cls):
        kind = hints[f.name]
        if "dtype" in f.metadata:
            dtype = np.dtype(f.metadata["dtype"]).newbyteorder("<")
            arrays.append(_Array(f.name, dtype, tuple(f.metadata["shape"])))
        elif kind is float:
            floats.append(f.name)
        elif kind in (int, bool, str):
            plain.append(_Plain(f.name, kind))
        elif kind == dict[str, str]:
            plain.append(_Plain(f.name, dict))
        else:
            raise TypeError(f"{cls.__name__}.{f.name}: messages can't carry {kind}")
    packer = struct.Struct(f"<{len(floats)}d")
    return _Plan(tuple(floats), packer.pack, packer.unpack_from, tuple(plain), tuple(arrays))


def pack(message: Any) -> bytes:
    """The message as bytes. Raises BusError for a value that its field does not allow."""
    cls = type(message)
    plan = _plan(cls)
    name = "/".join(plan.floats)
    try:
        head = plan.pack_floats(*[getattr(message, n) for n in plan.floats])
        # the name is bound as it goes, so that the error can say which field was wrong
        values = [p.outgoing(getattr(message, name := p.name)) for p in plan.plain]
    except (TypeError, OverflowError, struct.error) as error:
        raise BusError(f"can't send {cls.__name__}.{name}: {error}") from None
    shapes: list[list[Any]] = []
    parts: list[Any] = []
    for field in plan.arrays:
        value = getattr(message, field.name)
        if not isinstance(value, np.ndarray) or value.dtype != field.dtype or not field.fits(value.shape):
            raise BusError(
                f"can't send {cls.__name__}.{field.name}: needs {field.dtype} {field.shape}, "
                f"is {getattr(value, 'dtype', type(value).__name__)} {getattr(value, 'shape', '')}"
            )
        shapes.append([field.dtype.str, *value.shape])
        parts.append(value if value.flags.c_contiguous else np.ascontiguousarray(value))
        if value.nbytes % 8:
            parts.append(_PADDING[-value.nbytes % 8])
    header = _encode([cls.__name__, values, shapes]).encode()
    if len(header) > MAX_HEADER:
        raise BusError(f"can't send {cls.__name__}: its texts take {len(header)} of {MAX_HEADER} bytes")
    prefix = _PREFIX.pack(MAGIC, VERSION, len(plan.floats), len(header), 0)
    return b"".join([prefix, head, header, _PADDING[-len(header) % 8], *parts])


def unpack(data: bytes | memoryview, cls: type[Message]) -> Message:
    """The message of type ``cls`` in ``data``; its arrays are read-only views of ``data``.

    Raises BusError for anything that :func:`pack` would not have written for ``cls``.
    """
    try:
        return _unpack(data, cls)
    except (ValueError, TypeError, KeyError, IndexError, RecursionError, struct.error) as error:
        raise BusError(f"malformed {cls.__name__} message: {error}".replace("\n", " ")[:200]) from None


def _unpack(data: bytes | memoryview, cls: type[Message]) -> Message:
    plan = _plan(cls)
    magic, version, floats, length, zero = _PREFIX.unpack_from(data)
    if magic != MAGIC or zero != 0:
        raise ValueError("not a message of prism_edge")
    if version != VERSION:
        raise ValueError(f"layout version {version}, this is version {VERSION}")
    if floats != len(plan.floats):
        raise ValueError(f"{floats} float fields instead of {len(plan.floats)}: of another build?")
    start = _PREFIX.size + 8 * floats
    if length > MAX_HEADER or start + length > len(data):
        raise ValueError(f"a header of {length} bytes in {len(data)} bytes")
    name, values, shapes = _decode(bytes(data[start : start + length]).decode())
    if name != cls.__name__:
        raise ValueError(f"it says it is {name!r:.40}")
    if (len(values), len(shapes)) != (len(plan.plain), len(plan.arrays)):
        raise ValueError("it has other fields: its sender is of another build")
    given: dict[str, Any] = dict(zip(plan.floats, plan.unpack_floats(data, _PREFIX.size), strict=True))
    for plain, value in zip(plan.plain, values, strict=True):
        if not plain.accepts(value):
            raise ValueError(f"{plain.name} is {value!r:.40}")
        given[plain.name] = value
    position = _padded(data, start + length)
    for field, (dtype, *shape) in zip(plan.arrays, shapes, strict=True):
        sizes = all(type(n) is int and n >= 0 for n in shape)
        if dtype != field.dtype.str or not sizes or not field.fits(shape):
            raise ValueError(f"{field.name} is {dtype!r:.20} {shape!r:.40}")
        count = prod(shape)
        end = position + count * field.dtype.itemsize
        if end > len(data):
            raise ValueError(f"truncated in {field.name}")
        given[field.name] = _view(data, field, count, position).reshape(shape)
        position = _padded(data, end)
    if position != len(data):
        raise ValueError(f"{len(data) - position} bytes too many")
    return cls(**given)


def _padded(data: bytes | memoryview, end: int) -> int:
    """The next multiple of 8, once the bytes up to it are known to be zeros."""
    padding = -end % 8
    if bytes(data[end : end + padding]) != _PADDING[padding]:
        raise ValueError("truncated, or its padding is not zero")
    return end + padding


def _view(data: bytes | memoryview, field: _Array, count: int, position: int) -> np.ndarray[Any, Any]:
    if count == 0:
        return np.empty(0, field.dtype)  # frombuffer refuses an empty rest
    view: np.ndarray[Any, Any] = np.frombuffer(data, field.dtype, count, position)
    if field.dtype.kind == "b" and view.view(np.uint8).max() > 1:
        raise ValueError(f"{field.name} holds more than true and false")
    return view
