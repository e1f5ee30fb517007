"""Small whole numbers sorted without a comparison."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def order_of(numbers: NDArray[np.integer[Any]], below: int) -> NDArray[np.intp]:
    """What sorts whole numbers (n,), none of them negative, all less than ``below``; like ones as they came.

    NumPy sorts those of 16 bits by their digits. Longer ones it compares, and what comes out differs from
    image to image: each second time the processor has guessed wrong, which takes longer than all the rest.
    """
    return np.argsort(numbers.astype(np.uint16) if below <= 1 << 16 else numbers, kind="stable")
