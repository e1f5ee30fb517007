"""How gtsam is to solve a bundle adjustment: in which order variables go, and how it is damped."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from prism_edge.geometry.poses import Array

MOST_DAMPING = 1e10
ONE_BY_ONE = 100  # poses up to which elimination one by one has less about it than cliques have


def points_first(points: Iterable[int], keyframes: Iterable[int], last: Iterable[int] = ()) -> gtsam.Ordering:
    """Points, each of which joins poses alone; poses as they were made; then what is joined with all others.

    gtsam finds as good an order by itself, but takes as long for it as for two iterations where one variable,
    the lens, is in all factors.
    """
    return gtsam.Ordering([*map(L, points), *map(X, keyframes), *last])


def solver(ordering: gtsam.Ordering, poses: int) -> gtsam.LevenbergMarquardtParams:
    """The parameters of a bundle adjustment of so many poses."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(ordering)
    if poses <= ONE_BY_ONE:
        parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    parameters.setlambdaInitial(1e-4)
    # gtsam's own limit, 1e5, is less than a pixel's weight: it would give up where steps have to be small.
    parameters.setlambdaUpperBound(MOST_DAMPING)
    return parameters


def covariance_of_last(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering
) -> Array:
    """The marginal covariance (n, n) of the variable that an ordering ends with, at a solution.

    gtsam's own ``Marginals`` takes no ordering. Raises RuntimeError or LinAlgError where the system is
    indeterminate.
    """
    solved = graph.linearize(values).eliminateSequential(ordering)
    last = solved.back()  # a view into what was solved, which must live as long
    root = np.array(last.R(), np.float64)
    covariance: Array = np.linalg.inv(root.T @ root).astype(np.float64)
    return covariance
