"""The map of a town: crossings and the streets between them, and a drive that leaves no street out."""

from __future__ import annotations

from collections import deque

import numpy as np

Node = tuple[int, int]  # column and row of a crossing
SIDE = 3
NODES: tuple[Node, ...] = tuple((column, row) for row in range(SIDE) for column in range(SIDE))
STREETS: tuple[tuple[Node, Node], ...] = tuple(
    (node, (node[0] + dx, node[1] + dy))
    for node in NODES
    for dx, dy in ((1, 0), (0, 1))
    if (node[0] + dx, node[1] + dy) in NODES
)


def beside(node: Node) -> list[Node]:
    """The crossings that a street leads to from one."""
    return [b if a == node else a for a, b in STREETS if node in (a, b)]


def tour(rng: np.random.Generator) -> list[Node]:
    """Crossings of a closed drive in order, the first not repeated: every street, and never straight back.

    At each crossing it goes on where it has been least, by chance among equals, and home by the fewest
    streets when it has been everywhere.
    """
    way = [NODES[rng.integers(len(NODES))]]
    way.append(_any(rng, beside(way[0])))
    driven = dict.fromkeys(STREETS, 0)
    driven[_street(way[0], way[1])] += 1
    while min(driven.values()) == 0:
        onward = [node for node in beside(way[-1]) if node != way[-2]]
        least = min(driven[_street(way[-1], node)] for node in onward)
        way.append(_any(rng, [node for node in onward if driven[_street(way[-1], node)] == least]))
        driven[_street(way[-2], way[-1])] += 1
    return _home(way)


def _any(rng: np.random.Generator, nodes: list[Node]) -> Node:
    return nodes[rng.integers(len(nodes))]


def _street(a: Node, b: Node) -> tuple[Node, Node]:
    return (a, b) if (a, b) in STREETS else (b, a)


def _home(way: list[Node]) -> list[Node]:
    """Goes on to the start by the fewest streets, so that setting out again is no turn straight back."""
    waiting, seen = deque([tuple(way[-2:])]), {tuple(way[-2:])}
    ways = {waiting[0]: way}
    while waiting:
        state = waiting.popleft()
        before, here = state
        if here == way[0] and before != way[1]:
            return ways[state][:-1]
        for node in beside(here):
            if node != before and (here, node) not in seen:
                seen.add((here, node))
                ways[here, node] = [*ways[state], node]
                waiting.append((here, node))
    raise AssertionError("every crossing of a grid can be reached")
