"""Values of every internal message type, made from the dataclasses' own declarations."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, get_type_hints

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from prism_edge import messages as m
from prism_edge.topics import TOPICS

TYPES = sorted({t.type for t in TOPICS.values() if not isinstance(t.type, str)}, key=lambda t: t.__name__)

_SCALARS: dict[Any, st.SearchStrategy[Any]] = {
    int: st.integers(-(2**63), 2**63 - 1),
    float: st.floats(),  # NaN and infinities included
    bool: st.booleans(),
    str: st.text(max_size=20),
    dict[str, str]: st.dictionaries(st.text(max_size=5), st.text(max_size=5), max_size=4),
}


def messages_of(cls: type) -> st.SearchStrategy[Any]:
    """Any value of this message type."""
    hints = get_type_hints(cls)
    given = {}
    for f in fields(cls):
        if "dtype" in f.metadata:
            sizes = [st.integers(0, 3) if n == -1 else st.just(n) for n in f.metadata["shape"]]
            given[f.name] = hnp.arrays(f.metadata["dtype"], st.tuples(*sizes))
        else:
            given[f.name] = _SCALARS[hints[f.name]]
    return st.builds(cls, **given)


def same(a: Any, b: Any) -> bool:
    """Whether two messages are equal, bit by bit in their numbers."""
    if type(a) is not type(b):
        return False
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, np.ndarray):
            if x.dtype != y.dtype or x.shape != y.shape or x.tobytes() != y.tobytes():
                return False
        elif isinstance(x, float):
            if np.float64(x).tobytes() != np.float64(y).tobytes():
                return False
        elif type(x) is not type(y) or x != y:
            return False
    return True


def frame(index: int = 0) -> m.Frame:
    """A colour image of 640 x 480."""
    image = np.full((720, 640), index % 256, np.uint8)
    return m.Frame(index, index * 33, 7, True, False, "pinhole", np.arange(6.0), image)


def tracked(index: int = 0) -> m.Tracked:
    """A frame that was tracked."""
    return m.Tracked(index, index * 33, 7, m.OK, True, -1, 0, np.eye(4))


def linked(*buses):
    """Every one is ready and linked to all the others."""
    for bus in buses:
        bus.pulse.ready()
    for bus in buses:
        assert bus.await_ready([other.process for other in buses], 10.0) == set()


def end(index):
    return m.EndOfStream(index + 1, index + 1, 0, 0, index)
