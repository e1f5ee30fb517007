"""What repeats is not sure; who is asked stands not too far aside; networks that crop; double corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import from_rt
from prism_edge.reconstruction.consensus import consensus
from prism_edge.reconstruction.in_the_map import FARTHEST, aligned, from_relative
from prism_edge.reconstruction.look import Look
from prism_edge.reconstruction.sweep import BASELINES, sweep, with_baseline
from prism_edge.scale.gate import DepthView, GateParameters
from tests.reconstruction.test_in_the_map import DEPTH, TO_DEPTH, X, viewpoint

WHOLE = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
NONE = np.zeros((0, 0), np.float32)


def facing(x: float, pattern: object, depth: float = 2.0, grain: float = 0.0) -> Look:
    """A wall 2 m ahead, ``pattern`` (m along it) its brightness, seen from x."""
    v, u = np.mgrid[0:120, 0:160]
    grey = 128.0 + pattern(x + (u - WHOLE.cx) / WHOLE.fx * 2.0, (v - WHOLE.cy) / WHOLE.fy * 2.0)
    grey = grey + grain * np.random.default_rng(round(100 * x)).standard_normal(grey.shape)
    pose = from_rt(np.eye(3), np.array([x, 0.0, 0.0]))
    there = np.full((120, 160), depth, np.float32)
    view = DepthView(round(100 * x), pose, WHOLE, there, np.array([1.0, 0, 1.0, 0]), NONE, 1.0)
    grey = np.clip(grey, 0, 255).astype(np.uint8)
    return Look(view, grey, np.dstack([grey] * 3))


def stripes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 60.0 * np.sin(2.0 * np.pi * x / 0.06) * np.cos(2.0 * np.pi * y / 0.3)


def speckle(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Waves that repeat nowhere near."""
    rng = np.random.default_rng(0)
    waves = rng.normal(0.0, 25.0, (40, 2)), rng.uniform(0.0, 6.3, 40)
    return 12.0 * sum(np.sin(k[0] * x + k[1] * y + p) for k, p in zip(*waves, strict=True))


def test_a_pattern_that_repeats_along_the_way_is_not_sure() -> None:
    """From 0.5 m aside a stripe matches the next one at another depth just as well."""
    inner = slice(30, 90), slice(60, 100)
    once = sweep(facing(0.0, speckle), [facing(0.5, speckle)])
    assert once.sure[inner].mean() > 0.5
    again = sweep(facing(0.0, stripes), [facing(0.5, stripes)])
    assert again.sure[inner].mean() < 0.05


def test_who_stands_too_far_aside_is_not_asked() -> None:
    here = facing(0.0, speckle)
    within, beyond = (facing(2.0 * BASELINES[1] * share, speckle) for share in (0.9, 1.1))
    assert with_baseline(here, [within, beyond]) == [within]


def test_what_the_gate_takes_for_hidden_is_not_held_against_a_pixel() -> None:
    """The other sees something 8 % nearer in its place: less than tau, so that counts, as the gate says."""
    here, other = facing(0.0, speckle), facing(0.1, speckle, depth=2.0 * np.exp(-0.08))
    gate = GateParameters(0.5, 0.1, 0.02)
    found = consensus(here, [other], 0.03, gate)
    inner = slice(30, 90), slice(60, 100)
    expected = 1.0 / (1.0 + np.exp((0.08 - 0.1) / 0.02))
    assert found.weights[inner] == pytest.approx(expected, abs=0.01)


def test_a_cropped_depth_map_is_bent_where_its_pixels_are() -> None:
    """A network that sees the middle of the image: its map begins 60 pixels in."""
    off = np.exp(0.12 * np.sin(X / 60.0)).astype(np.float32)
    whole = viewpoint(800)
    crop = np.s_[:, 60:260]
    made = aligned((DEPTH * off)[crop], TO_DEPTH - np.array([0.0, 60.0, 0.0, 0.0]), whole)
    assert made is not None
    before, after = (np.abs(np.log(d / DEPTH[crop])) for d in ((DEPTH * off)[crop], made))
    assert np.median(after) < 0.3 * np.median(before)


def test_inverse_depth_next_to_nothing_is_no_depth() -> None:
    inverse = (1.0 / DEPTH).astype(np.float32)
    view = viewpoint()
    inverse[100:140, 100:200] = 1.0 / (2.0 * FARTHEST * view.depths.max())
    keep = ~((view.pixels[:, 0] > 190) & (view.pixels[:, 0] < 410) & (view.pixels[:, 1] > 190))
    view = replace(view, pixels=view.pixels[keep], depths=view.depths[keep])
    made = from_relative(inverse, TO_DEPTH, view, True)
    assert made is not None
    assert (made[105:135, 105:195] == 0).all()
    assert (made[:90] > 0).all()
