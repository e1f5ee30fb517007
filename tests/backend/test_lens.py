"""The lens that a camera file lacks, against a cloud seen through a known one."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from prism_edge.backend import lens as lens_module
from prism_edge.backend import loop_closing
from prism_edge.backend.global_adjustment import GlobalAdjustment, apply
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.lens import Lens, LensWatch, common
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import Keyframe
from tests.backend.ring import position_error
from tests.backend.world import Teller, check
from tests.tracking.cloud import CAMERA, pose_at

CONFIG = BackendConfig()


def path(count: int) -> list[np.ndarray]:
    """Back and forth, with a little turning."""
    return [
        pose_at(0.15 * (i % 11), 0.03 * i, 0.0, 0.0, 0.01 * (i % 7) - 0.03 * (i % 3)) for i in range(count)
    ]


def firm(world: GlobalMap) -> None:
    """As after a window's solution: all rays cross well."""
    for point in world.points.values():
        point.parallax_deg = 5.0


def seen_through(
    k1: float, count: int = 22, noise_px: float = 0.5, seed: int = 0
) -> tuple[Teller, GlobalMap]:
    """Keyframes of a camera that is said to be ideal, and is CAMERA.bent(k1)."""
    teller, world, true = Teller(count=500, noise_px=noise_px, seed=seed), GlobalMap(), CAMERA.bent(k1)
    for pose in path(count):
        message = teller.keyframe(pose)
        raw = true.distort_pixels(message.pixels.astype(np.float64))
        world.absorb(replace(message, pixels=raw.astype(np.float32)))
    firm(world)
    return teller, world


def look(world: GlobalMap, said_k1: float = 0.0) -> GlobalAdjustment:
    job = GlobalAdjustment(world, CONFIG, 1.0, use_depth=False, said_k1=said_k1)
    while not job.step():
        pass
    return job


@pytest.mark.parametrize("k1", [-0.06, 0.06])
def test_a_lens_is_found_within_its_sigma_and_taken_out(k1):
    teller, world = seen_through(k1)
    said = world.camera
    adjusted = look(world).result()
    assert adjusted.lens.is_taken
    assert abs(adjusted.lens.k1 - k1) < 2.0 * adjusted.lens.sigma
    apply(world, adjusted, CONFIG)
    assert world.camera == said.bent(adjusted.lens.k1)
    assert len({keyframe.camera for keyframe in world.keyframes.values()}) == 1
    check(world)
    poses = {k: f.world_from_camera for k, f in world.keyframes.items()}
    _, bent = seen_through(k1)
    without = GlobalAdjustment(bent, CONFIG, 1.0, use_depth=False)
    while not without.step():
        pass
    assert position_error(poses, teller.poses) < 0.7 * position_error(without.result().poses, teller.poses)


def test_pixels_are_then_where_the_points_are():
    teller, world = seen_through(-0.05, noise_px=0.0)
    apply(world, look(world, said_k1=-0.05).result(), CONFIG)  # nothing then draws it away from the truth
    errors = []
    for k, keyframe in world.keyframes.items():
        places = np.array([teller.cloud.positions[p] for p in keyframe.observed])
        keypoints = list(keyframe.observed.values())
        projected = CAMERA.ideal().project(transform(inverse(teller.poses[k]), places))
        errors.append(np.abs(projected - keyframe.pixels[keypoints]).max())
        assert keyframe.features.pixels == pytest.approx(keyframe.pixels)
    assert max(errors) < 0.3  # and were up to 8 pixels off


def test_the_unit_is_held_as_it_is_wherever_the_map_lies():
    places = (pose_at(), pose_at(1.0), pose_at(3.0, 4.0))  # the last one is the farthest, by 5
    poses = {k: pose_at(90.0, -40.0) @ pose for k, pose in zip((3, 4, 5), places, strict=True)}
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    lens_module.hold_unit(graph, poses)
    for k, pose in poses.items():
        values.insert(X(k), gtsam.Pose3(pose))
    assert graph.error(values) == pytest.approx(0.0, abs=1e-9)
    values.update(X(5), gtsam.Pose3(poses[3] @ pose_at(3.06, 4.08)))
    assert graph.error(values) == pytest.approx(0.5 * (0.02 / lens_module.UNIT_SIGMA) ** 2)


@pytest.mark.parametrize("seed", range(5))
def test_a_lens_that_is_as_said_is_left_alone(seed):
    _, world = seen_through(0.0, seed=seed)
    found = look(world).result().lens
    assert not found.is_taken
    assert abs(found.k1) < 2.0 * found.sigma


def test_what_is_found_is_weighed_against_what_was_said():
    """A file that says -0.05 where it is -0.11: each pixel was undistorted by the wrong one."""
    said, true = CAMERA.bent(-0.05), CAMERA.bent(-0.11)
    teller, world = Teller(count=500, noise_px=0.5), GlobalMap()
    for pose in path(22):
        message = teller.keyframe(pose)
        pixels = said.pixels_of(true, message.pixels.astype(np.float64)).astype(np.float32)
        world.absorb(replace(message, pixels=pixels, camera=said.to_array()))
    firm(world)
    found = look(world, -0.05).result()
    assert found.lens.is_taken
    apply(world, found, CONFIG)
    first = world.camera.distortion[0]
    assert first == pytest.approx(-0.11, abs=0.015)
    # The same keyframes say the same again: the prior stays where the file put it.
    again = look(world, -0.05).result().lens
    assert abs(again.k1) < 0.1 * again.sigma
    assert not again.is_taken


def test_the_less_is_known_the_more_the_file_counts():
    few, many = (look(seen_through(-0.04, count=count)[1]).result().lens for count in (6, 22))
    assert few.sigma > 1.5 * many.sigma
    assert few.sigma < lens_module.PRIOR_SIGMA
    assert few.k1 - -0.04 > many.k1 - -0.04 > -0.002  # nearer to what was said


def test_a_pure_rotation_of_far_points_says_nothing_that_is_wrong():
    teller, world = Teller(count=500, noise_px=0.5), GlobalMap()
    for i in range(22):
        world.absorb(teller.keyframe(pose_at(0.0, 0.0, 0.0, 0.0, 0.01 * i)))
    adjusted = look(world).result()
    assert adjusted is None or adjusted.lens is None or not adjusted.lens.is_taken


def test_points_that_are_nowhere_near_have_no_say():
    _, world = seen_through(-0.05)
    astray = sorted(world.points)[::40]
    clean = look(world).result()
    for p in astray[::2]:
        world.points[p].position = world.points[p].position * (1.0, 1.0, -1.0)  # behind all cameras
    for p in astray[1::2]:
        world.points[p].position = world.points[p].position + np.array([0.5, 0.0, 0.0])
    found = look(world).result()
    assert not set(astray) & set(found.points)
    assert found.lens.k1 == pytest.approx(clean.lens.k1, abs=0.3 * clean.lens.sigma)


def test_a_keyframe_from_before_is_brought_to_the_lens():
    teller, world = seen_through(-0.05, noise_px=0.0)
    apply(world, look(world, said_k1=-0.05).result(), CONFIG)  # nothing then draws it away from the truth
    late = teller.keyframe(pose_at(0.5, 0.1))
    raw = CAMERA.bent(-0.05).distort_pixels(late.pixels.astype(np.float64))
    added = world.absorb(replace(late, pixels=raw.astype(np.float32)))
    assert added.camera == world.keyframes[0].camera
    assert added.pixels == pytest.approx(late.pixels.astype(np.float64), abs=0.3)
    assert common(world) is not None


@pytest.mark.parametrize(("model", "size"), [(FISHEYE, 640), (CAMERA.model, 320)])
def test_only_one_pinhole_camera_is_looked_into(model, size):
    teller, world = seen_through(0.0, count=2)
    other = replace(CAMERA, model=model, width=size)
    world.absorb(replace(teller.keyframe(pose_at(0.4)), camera_model=model, camera=other.to_array()))
    assert common(world) is None
    assert look(world).result().lens is None
    assert not LensWatch(True).due(world)


def test_it_is_looked_for_as_the_map_grows(monkeypatch):
    _, world = seen_through(0.0, count=6)
    monkeypatch.setattr(lens_module, "FIRST", 4)
    watch = LensWatch(True)
    assert watch.due(world)
    watch.looked(world)
    assert not watch.due(world)
    watch.finish()
    assert not watch.due(world)  # nothing has come since
    world.keyframes[99] = replace(world.keyframes[0], id=99)
    assert watch.due(world)
    assert not LensWatch(False).due(world)


def test_a_lens_that_is_known_is_looked_for_less():
    _, world = seen_through(0.0, count=22)
    seldom, often = LensWatch(True), LensWatch(True)
    for watch, sigma in ((seldom, 0.001), (often, 0.01)):
        watch.looked(world, Lens(CAMERA, 0.0, sigma))
    for k in range(100, 110):
        world.keyframes[k] = replace(world.keyframes[0], id=k)
    assert often.due(world)
    assert not seldom.due(world)


@pytest.mark.parametrize(
    ("k1", "sigma", "off"),
    [(0.02, 0.005, True), (0.012, 0.01, False), (0.022, 0.01, True), (0.03, 0.0, False)],
)
def test_what_is_likely(k1, sigma, off):
    assert Lens(CAMERA, k1, sigma).is_off is off
    assert Lens(CAMERA, -k1, sigma).is_off is off
    said = 0.05  # beside what was said it is the same
    assert Lens(CAMERA.bent(0.04), k1 + 0.01, sigma, said).is_off is off


def test_the_threshold_is_bayes_factor():
    """Against the integral over all lenses that the prior allows, for an estimate without it."""
    own, prior = 0.008, lens_module.PRIOR_SIGMA
    k1 = np.linspace(-0.3, 0.3, 200_001)

    def density(x: np.ndarray | float, sigma: float) -> np.ndarray:
        return np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))

    for seen in np.linspace(0.005, 0.04, 36):
        off = np.sum(density(k1 - seen, own) * density(k1, prior)) * (k1[1] - k1[0])
        share = prior**2 / (prior**2 + own**2)
        lens = Lens(CAMERA, float(seen * share), own * np.sqrt(share))
        assert lens.is_off == (off > lens_module.EXACT * density(seen, own))


def test_one_that_was_off_is_followed():
    bent = CAMERA.bent(-0.02)
    assert not Lens(CAMERA, -0.004, 0.004).is_taken
    assert Lens(bent, 0.016, 0.004).is_taken
    assert not Lens(bent, 0.0005, 0.004).is_taken  # no news


def test_lenses_add_up_to_a_bound_only():
    assert Lens(CAMERA.bent(0.08), 0.05, 0.01).is_taken
    assert not Lens(CAMERA.bent(0.12), 0.05, 0.01).is_taken


def test_one_that_would_show_a_ray_twice_is_none():
    wide = replace(CAMERA, fx=300.0, fy=300.0)
    assert Lens(CAMERA, -0.14, 0.01).is_taken
    assert not Lens(wide, -0.14, 0.01).is_taken


@pytest.mark.parametrize(
    "distortion", [(-0.28, 0.07, 0.0, 0.0), (0.02, 0.0, 0.001, 0.0), (-0.3, 0.0, 0.0, 0.0)]
)
def test_a_camera_that_was_calibrated_is_believed(distortion):
    _, world = seen_through(0.0, count=3)
    assert common(world) == CAMERA
    for keyframe in world.keyframes.values():
        keyframe.camera = replace(CAMERA, distortion=distortion)
    assert common(world) is None


def test_a_lens_without_a_covariance_changes_nothing(monkeypatch):
    """Places that were solved with it would go with no lens at all."""
    _, world = seen_through(-0.06)
    job = look(world)

    def unknown(*_: object) -> None:
        raise RuntimeError("indeterminate")

    monkeypatch.setattr(lens_module, "covariance_of_last", unknown)
    assert job.result() is None


def test_what_the_file_said_is_remembered():
    _, world = seen_through(0.0, count=3)
    watch = LensWatch(True)
    assert watch.said(world) == 0.0
    found = Lens(CAMERA, -0.03, 0.006, 0.0)
    assert watch.looked(world, found)
    world.take_lens(found.camera)
    assert watch.said(world) == 0.0
    assert not watch.looked(world, None)
    assert watch.said(world) == 0.0
    world.take_lens(CAMERA.bent(0.05))  # somebody else's: another camera, which says so
    assert watch.said(world) == 0.05
    for keyframe in world.keyframes.values():
        keyframe.camera = replace(CAMERA, model=FISHEYE)
    assert watch.said(world) is None


def mapper_of(k1: float, **changes: object) -> tuple[Mapper, list[Keyframe]]:
    """A mapper that has heard of keyframes of a camera with a lens that it wasn't told of."""
    teller, _ = seen_through(0.0, count=0)
    mapper, told = Mapper(replace(CONFIG, **changes), use_depth=False), []
    for pose in path(22):
        message = teller.keyframe(pose)
        raw = CAMERA.bent(k1).distort_pixels(message.pixels.astype(np.float64))
        told.append(replace(message, pixels=raw.astype(np.float32)))
        mapper.absorb(told[-1])
    firm(mapper.world)
    return mapper, told


def adjust_all(mapper: Mapper, looks: int = 3) -> list[bool]:
    """Whether each step came to something; the lens is looked for so many times at least."""
    came = []
    for _ in range(100):
        if not mapper.loops.adjusting and looks > 1:
            looks, mapper.loops._lens._next = looks - 1, 0
        if not mapper.loops.adjusting:
            return came
        came.append(mapper.loops.adjust(1.0) is not None)
    raise AssertionError("it never ends")


def test_the_update_after_it_carries_the_camera():
    mapper, told = mapper_of(-0.06)
    assert any(adjust_all(mapper))
    update = mapper.whole(told[-1].id, mapper.loops.take_changes())
    found = Camera.from_array(CAMERA.model, update.camera)
    assert found != CAMERA
    assert found.like(CAMERA)
    assert found.distortion[0] == pytest.approx(-0.06, abs=0.02)


@pytest.mark.parametrize(("k1", "lens"), [(0.0, True), (-0.06, False)])
def test_without_a_lens_or_the_setting_the_camera_is_as_said(k1, lens):
    mapper, told = mapper_of(k1, lens=lens)
    assert not any(adjust_all(mapper))
    update = mapper.whole(told[-1].id, mapper.loops.take_changes())
    assert update.camera.tolist() == CAMERA.to_array().tolist()


def test_a_recording_that_ends_is_looked_at_once_more():
    mapper, _ = mapper_of(0.0)
    adjust_all(mapper)
    assert not mapper.loops.unfinished
    mapper.loops.finish()
    assert mapper.loops.unfinished  # all keyframes together, at least
    while mapper.loops.unfinished:
        mapper.loops.adjust(1.0)
    mapper.loops.finish()
    assert not mapper.loops.unfinished


def test_a_search_into_which_another_camera_comes_is_dropped():
    mapper, told = mapper_of(-0.06)
    mapper.loops.adjust(1.0)  # begins
    wider = replace(CAMERA, width=700)
    mapper.absorb(replace(told[-1], id=99, camera=wider.to_array()))
    before = [k.world_from_camera.copy() for k in mapper.world.keyframes.values()]
    assert not any(adjust_all(mapper))
    for keyframe, pose in zip(mapper.world.keyframes.values(), before, strict=True):
        assert keyframe.world_from_camera == pytest.approx(pose)
        assert keyframe.camera.distortion == ()


def test_what_the_search_left_out_is_adjusted_at_once():
    mapper, _ = mapper_of(-0.06)
    assert adjust_all(mapper).count(True) == 2  # the lens, then everything with it


def test_windows_after_it_carry_the_camera_too():
    """The one update of everything may be lost on the way."""
    mapper, told = mapper_of(-0.06)
    adjust_all(mapper)
    update = mapper.optimise(told[-1].id, 0.0)
    assert Camera.from_array(CAMERA.model, update.camera) == mapper.world.camera != CAMERA


def test_the_prior_stays_where_the_file_put_it(monkeypatch):
    """Moved along with what was found, it would count the same keyframes again and again."""
    asked = []

    class Spy(GlobalAdjustment):
        def __init__(self, *args: object) -> None:
            asked.append((args[0].camera, args[5]))
            super().__init__(*args)

    monkeypatch.setattr(loop_closing, "GlobalAdjustment", Spy)
    mapper, _ = mapper_of(-0.06)
    adjust_all(mapper)
    searches = [(camera, said) for camera, said in asked if said is not None]
    assert [said for _, said in searches] == [0.0] * 3
    assert searches[0][0] == CAMERA != searches[-1][0]


def test_a_map_that_is_taken_up_again_is_not_searched_anew():
    mapper, _ = mapper_of(0.0)
    assert mapper.loops.adjusting
    info, arrays = mapper.stored()
    again = Mapper(CONFIG, use_depth=False)
    again.restore({**info, "log_scale": 0.0, "scale_sigma": 0.1}, arrays)
    assert not again.loops.adjusting
