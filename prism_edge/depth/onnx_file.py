"""What an ONNX file refers to, read by walking its protobuf fields, before any native code sees it.

Only what the vetting needs is decoded; the field numbers are those of onnx.proto (IR version 13). All else
is skipped by its length, so that weights are never touched, and the package `onnx` is not needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from prism_edge.errors import ModelError

Bytes = memoryview

# onnx.proto: message and field.
_MODEL_GRAPH, _MODEL_OPSET, _MODEL_PROPS = 7, 8, 14
_MODEL_TRAINING, _MODEL_FUNCTIONS = 20, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_SPARSE = 1, 5, 15
_NODE_OPERATOR, _NODE_ATTRIBUTE = 4, 5
_FUNCTION_NODE, _FUNCTION_DEFAULT = 7, 11  # the latter: an attribute with its value
_ATTRIBUTE_TENSOR, _ATTRIBUTE_TENSORS, _ATTRIBUTE_GRAPH, _ATTRIBUTE_GRAPHS = 5, 10, 6, 11
_ATTRIBUTE_SPARSE = (22, 23)
_SPARSE_TENSORS = (1, 2)  # values, indices
_TENSOR_NAME, _TENSOR_EXTERNAL, _TENSOR_LOCATION = 8, 13, 14
_OPSET_DOMAIN, _OPSET_VERSION = 1, 2
_ENTRY_KEY, _ENTRY_VALUE = 1, 2
_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5

CARD_PREFIX = "prism_edge."  # of a card's keys in metadata (depth/contract.py)
DEEPEST = 16  # graphs within graphs; exported networks have two
MOST_ENTRIES = 1_000  # of metadata
LONGEST_TEXT = 65_536  # bytes


@dataclass(frozen=True)
class External:
    """A tensor whose values lie in another file."""

    location: str  # as the file has it
    offset: int
    length: int  # bytes; 0: to the end of that file


@dataclass
class Outline:
    """What a file says of itself and refers to."""

    has_graph: bool = False
    opsets: dict[str, int] = field(default_factory=dict)  # domain ("" is ONNX's own): version
    metadata: dict[str, str] = field(default_factory=dict)  # without values longer than LONGEST_TEXT
    operators: set[str] = field(default_factory=set)
    external: list[External] = field(default_factory=list)


class _NotOnnxError(Exception):
    pass


def read_outline(content: Bytes, name: str) -> Outline:
    """The outline of an ONNX file's whole content; ``name`` names it in errors.

    Raises ModelError where the content is cut off, no ONNX, or nested absurdly deep.
    """
    outline = Outline()
    try:
        for number, value in _fields(content):
            _model_field(outline, number, value)
    except _NotOnnxError as error:
        raise ModelError(f"{name}: no ONNX model, or damaged ({error})") from None
    if not outline.has_graph:
        raise ModelError(f"{name}: no ONNX model, or damaged (there is no graph in it)")
    return outline


def _model_field(outline: Outline, number: int, value: int | Bytes) -> None:
    if number == _MODEL_GRAPH:
        outline.has_graph = True
        _walk_graph(outline, _message(value), 0)
    elif number == _MODEL_OPSET:
        parts = dict(_fields(_message(value)))
        outline.opsets[_text(parts.get(_OPSET_DOMAIN, b""))] = _integer(parts.get(_OPSET_VERSION, 0))
    elif number == _MODEL_PROPS:
        if len(outline.metadata) >= MOST_ENTRIES:
            raise _NotOnnxError("more metadata than any model has")
        parts = dict(_fields(_message(value)))
        key, said = _text(parts.get(_ENTRY_KEY, b"")), parts.get(_ENTRY_VALUE, b"")
        if key.startswith(CARD_PREFIX) and key in outline.metadata:  # of two scales the last would count
            raise _NotOnnxError(f"its metadata say {key[:60]} twice")
        if isinstance(said, int) or len(said) <= LONGEST_TEXT:  # else somebody's training log: no card's
            outline.metadata[key] = _text(said)
    elif number == _MODEL_FUNCTIONS:
        for inner, part in _fields(_message(value)):
            if inner == _FUNCTION_NODE:
                _walk_node(outline, _message(part), 0)
            elif inner == _FUNCTION_DEFAULT:
                _walk_attribute(outline, _message(part), 0)
    elif number == _MODEL_TRAINING:
        raise _NotOnnxError("it carries a training graph; export it for inference")


def _walk_graph(outline: Outline, graph: Bytes, depth: int) -> None:
    if depth > DEEPEST:
        raise _NotOnnxError(f"graphs nested more than {DEEPEST} deep")
    for number, value in _fields(graph):
        if number == _GRAPH_NODE:
            _walk_node(outline, _message(value), depth)
        elif number == _GRAPH_INITIALIZER:
            _walk_tensor(outline, _message(value))
        elif number == _GRAPH_SPARSE:
            _walk_sparse(outline, _message(value))


def _walk_node(outline: Outline, node: Bytes, depth: int) -> None:
    for number, value in _fields(node):
        if number == _NODE_OPERATOR:
            outline.operators.add(_text(value))
        elif number == _NODE_ATTRIBUTE:
            _walk_attribute(outline, _message(value), depth)


def _walk_attribute(outline: Outline, attribute: Bytes, depth: int) -> None:
    for kind, content in _fields(attribute):
        if kind in (_ATTRIBUTE_TENSOR, _ATTRIBUTE_TENSORS):
            _walk_tensor(outline, _message(content))
        elif kind in (_ATTRIBUTE_GRAPH, _ATTRIBUTE_GRAPHS):
            _walk_graph(outline, _message(content), depth + 1)
        elif kind in _ATTRIBUTE_SPARSE:
            _walk_sparse(outline, _message(content))


def _walk_sparse(outline: Outline, sparse: Bytes) -> None:
    for number, value in _fields(sparse):
        if number in _SPARSE_TENSORS:
            _walk_tensor(outline, _message(value))


def _walk_tensor(outline: Outline, tensor: Bytes) -> None:
    name, external, told = "", False, {}
    for number, value in _fields(tensor):
        if number == _TENSOR_NAME:
            name = _text(value)
        elif number == _TENSOR_LOCATION:
            external = external or _integer(value) != 0
        elif number == _TENSOR_EXTERNAL:
            external = True
            parts = dict(_fields(_message(value)))
            key = _text(parts.get(_ENTRY_KEY, b""))
            if key in told:  # which of the two counts is the reader's choice: not ours to guess
                raise _NotOnnxError(f"tensor {name[:40]!r} says its {key[:20]} twice")
            told[key] = _text(parts.get(_ENTRY_VALUE, b""))
    if external:
        offset, length = _whole(told.get("offset", "")), _whole(told.get("length", ""))
        outline.external.append(External(told.get("location", ""), offset, length))


def _fields(content: Bytes) -> Iterator[tuple[int, int | Bytes]]:
    """Field number and value, a whole number or the bytes of a length-delimited field."""
    at, end = 0, len(content)
    while at < end:
        tag, at = _varint(content, at, end)
        number, kind = tag >> 3, tag & 7
        value: int | Bytes
        if not 0 < number < 1 << 29:  # some readers would take the lower bits alone
            raise _NotOnnxError("a field without a number")
        if kind == _VARINT:
            value, at = _varint(content, at, end)
        elif kind == _LENGTH:
            length, at = _varint(content, at, end)
            value = content[at : at + length]
            at += length
        elif kind in (_FIXED64, _FIXED32):
            width = 8 if kind == _FIXED64 else 4
            value = int.from_bytes(content[at : at + width], "little")
            at += width
        else:
            raise _NotOnnxError("a field of a kind that ONNX does not have")
        if at > end:
            raise _NotOnnxError("it is cut off")
        yield number, value


def _varint(content: Bytes, at: int, end: int) -> tuple[int, int]:
    result = 0
    for shift in range(0, 70, 7):
        if at >= end:
            raise _NotOnnxError("it is cut off")
        byte = content[at]
        at += 1
        result |= (byte & 0x7F) << shift
        if byte < 0x80:
            return result, at
    raise _NotOnnxError("a number too long")


def _message(value: int | Bytes) -> Bytes:
    if isinstance(value, int):
        raise _NotOnnxError("a number where a message belongs")
    return value


def _integer(value: int | Bytes) -> int:
    if not isinstance(value, int):
        raise _NotOnnxError("a message where a number belongs")
    return value


def _text(value: int | Bytes | bytes) -> str:
    if isinstance(value, int):
        raise _NotOnnxError("a number where text belongs")
    if len(value) > LONGEST_TEXT:
        raise _NotOnnxError(f"a text of more than {LONGEST_TEXT} bytes")
    try:
        return bytes(value).decode("utf-8")
    except UnicodeDecodeError:
        raise _NotOnnxError("a text that is not UTF-8") from None


def _whole(text: str) -> int:
    if not text:
        return 0
    if not text.isascii() or not text.isdigit() or len(text) > 18:
        raise _NotOnnxError(f"an offset or length of {text[:20]!r}")
    return int(text)
