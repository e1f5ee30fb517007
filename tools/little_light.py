"""Recorded images as they would be in little light: darker, and as noisy as that makes them."""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray


def dimmed(pixels: NDArray[np.uint8], light: float, index: int) -> NDArray[np.uint8]:
    """Image ``index`` with a share of its light and Poisson's noise, a grey level a photon; 1: as it is."""
    if light >= 1.0:
        return pixels
    photons = np.random.default_rng(index).poisson(light * pixels.astype(np.float32))
    return np.minimum(photons, 255).astype(np.uint8)


def share_of_light(text: str) -> float:
    """A command's ``--light``; raises ArgumentTypeError for what is no share."""
    try:
        light = float(text)
    except ValueError:
        light = 0.0
    if not 0.0 < light <= 1.0:
        raise argparse.ArgumentTypeError(f"{text}: a share of the light, above 0, 1 at most")
    return light
