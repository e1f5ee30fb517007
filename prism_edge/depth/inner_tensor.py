"""A place descriptor from a depth network that has no output for one: an inner tensor, pooled.

An ONNX file is one protobuf message, and a parser merges a message field that occurs twice. So a graph
that holds nothing but one more output, appended to the file's bytes, gives the network that output:
neither the file is changed nor the package `onnx` needed. Layers and poolings are compared in
docs/MODELS.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.errors import ModelError
from prism_edge.messages import F32

# How a tensor becomes a vector: of a map (1, C, h, w), or of tokens (1, n, C).
TOKEN, MEAN, MAX, GEM, GRID = "token", "mean", "max", "gem", "grid"
POOLINGS = (TOKEN, MEAN, MAX, GEM, GRID)
GEM_POWER = 3.0
GEM_FLOOR = 1e-6  # keeps the root's slope finite where a channel is silent

# Field numbers of onnx.proto: ModelProto.graph, GraphProto.output, ValueInfoProto.name.
_GRAPH, _OUTPUT, _NAME = 7, 12, 1
_LENGTH_DELIMITED = 2  # protobuf's wire type of strings and messages


def with_output(model: bytes, tensor: str) -> bytes:
    """The ONNX file ``model`` with its inner ``tensor`` as one more output, after those it has.

    That there is such a tensor shows when the result is loaded. Raises ModelError for an empty name.
    """
    if not tensor:
        raise ModelError("an inner tensor needs a name")
    value_info = _field(_NAME, tensor.encode())
    return model + _field(_GRAPH, _field(_OUTPUT, value_info))


def pool(tensor: NDArray[Any], pooling: str) -> F32:
    """One vector of unit length (n,) float32 from a map (1, C, h, w) or tokens (1, n, C).

    ``mean``, ``max`` and ``gem`` (generalised mean, Radenovic et al. 2018, p = 3) run over the whole map
    or over all tokens and give C numbers; ``grid`` gives the means of the map's four quarters, 4 C
    numbers, left to right and top to bottom; ``token`` the first token, which is the class token. A
    tensor that is silent (all 0) gives no descriptor, (0,). Raises ModelError where tensor and pooling
    don't go together.
    """
    shape = list(tensor.shape)
    if tensor.ndim not in (3, 4) or shape[0] != 1 or min(shape) < 1:
        raise ModelError(f"a tensor of shape {shape} can't be pooled: a map (1, C, h, w) or tokens (1, n, C)")
    values = np.asarray(tensor[0], dtype=np.float32)
    if pooling == TOKEN:
        if values.ndim != 2:
            raise ModelError(f"a tensor of shape {shape} is a map, which has no first token")
        vector = values[0]
    elif pooling == GRID:
        if values.ndim != 3 or min(values.shape[1:]) < 2:
            raise ModelError(f"a tensor of shape {shape} has no quarters, as a map (1, C, h, w) has")
        vector = np.concatenate([quarter.mean(axis=(1, 2)) for quarter in _quarters(values)])
    else:
        places = values.T if values.ndim == 2 else values.reshape(len(values), -1)  # (C, n)
        vector = _over_all(places, pooling)
    norm = float(np.linalg.norm(vector))
    return np.zeros(0, np.float32) if norm == 0.0 else (vector / np.float32(norm)).astype(np.float32)


def halves(extent: int) -> tuple[slice, slice]:
    """The two halves of an axis; the second is the longer one where its length is odd."""
    return slice(0, extent // 2), slice(extent // 2, extent)


def _quarters(values: F32) -> list[F32]:
    _, height, width = values.shape
    return [values[:, rows, columns] for rows in halves(height) for columns in halves(width)]


def _over_all(places: F32, pooling: str) -> F32:
    if pooling == MEAN:
        return np.asarray(places.mean(axis=1))
    if pooling == MAX:
        return np.asarray(places.max(axis=1))
    if pooling == GEM:
        powers = (np.maximum(places, 0.0) + GEM_FLOOR) ** GEM_POWER
        return np.asarray(powers.mean(axis=1) ** (1.0 / GEM_POWER))
    raise ModelError(f"pooling {pooling!r} is none of {', '.join(POOLINGS)}")


def _field(number: int, content: bytes) -> bytes:
    """A length-delimited protobuf field."""
    return _varint(number << 3 | _LENGTH_DELIMITED) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first; the top bit says that another byte follows."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])
