"""The simulator as a source: an endless camera in a world that exists only by its seed."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.messages import F32, I64
from prism_edge.named_path import named_path
from prism_edge.sources.base import Image, Slot, Source
from prism_edge.sources.sim import corridor, stairs, streets
from prism_edge.sources.sim.actors import Walker, walkers_at
from prism_edge.sources.sim.effects import Sensor
from prism_edge.sources.sim.floorplan import Plan, make_plan, room_about
from prism_edge.sources.sim.followed import Followed
from prism_edge.sources.sim.options import CORRIDOR, OUTDOORS, STAIRS, TOWN, Options, parse
from prism_edge.sources.sim.paths import (
    DRIVEN_OVERLAP,
    OVERLAP,
    SPEEDS,
    CameraPath,
    Driven,
    lap_length,
    make_path,
)
from prism_edge.sources.sim.renderer import Renderer
from prism_edge.sources.sim.there_and_back import ThereAndBack
from prism_edge.sources.sim.world import World, build_world
from prism_edge.sources.stamps import at_rate

log = logging.getLogger("prism_edge.sources")

_USUAL_FRAMES = 900


class SimSource(Source):
    """Pictures from ``sim:`` addresses. Poses and depth of any frame are to be had at any time.

    Nothing is built before :meth:`open`; stamps and the truth need no world and can be asked before.
    """

    synthetic = True

    def __init__(self, uri: str) -> None:
        """Raises SourceError where the address is wrong."""
        self.options: Options = parse(uri)
        o = self.options
        way = Path(o.follow).name if o.follow else o.path
        self.name = f"simulated {o.kind}, seed {o.seed}, {way}, {o.width}x{o.height}"
        centre = (o.width - 1) / 2, (o.height - 1) / 2
        try:
            self.camera = Camera(o.width, o.height, o.focal_length, o.focal_length, *centre)
        except ConfigError as error:
            raise SourceError(f"{uri}: {error}") from None
        self.camera_origin = "the simulator's own"
        self.period_ns = at_rate(1, o.rate)
        self.plan, self.path = _plan_and_path(o)
        self.frame_count: int = o.frames or self._usual_frames()
        self._next = 0
        self._is_open = False
        self._renderer: Renderer | None = None
        self._walkers: list[Walker] = []
        self._sensor: Sensor | None = None

    def _usual_frames(self) -> int:
        if isinstance(self.path, Followed):
            return int(self.path.length_s * self.options.rate) + 1
        if isinstance(self.path, ThereAndBack):
            return int(self.path.period_s * self.options.rate) + 1
        lap = lap_length(self.path)
        if self.plan.route is None or not lap:
            return _USUAL_FRAMES
        speed = self.options.speed or SPEEDS[self.options.path, True]
        if isinstance(self.path, Driven):
            seconds = self.path.lap_s + DRIVEN_OVERLAP / speed
        else:
            seconds = (lap + OVERLAP) / speed
        return int(np.ceil(seconds * self.options.rate))

    def open(self) -> None:
        """Builds the world, unless it stands from an earlier time."""
        self._next, self._is_open = 0, True
        if self._renderer is not None:
            return
        o = self.options
        world = _world(self.plan, o)
        rng = np.random.default_rng([o.seed, 7])
        lanes = [self.plan.lanes[k] for k in rng.permutation(len(self.plan.lanes))[: o.actors]]
        textures = list(world.textures)
        self._walkers = [Walker.random(rng, lane, textures) for lane in lanes]
        self._renderer = Renderer(World(world.cells, textures, world.plan), self.camera)
        self._sensor = Sensor(self.camera, self.path, o.seed, o.noise, o.blur, o.exposure, o.readout)

    def close(self) -> None:
        """Ends reading. The world stays as long as this object, so that a looped source opens at once."""
        self._is_open = False

    def peek(self) -> Slot | None:
        """Number and stamp of the next frame."""
        if self._next >= self.frame_count:
            return None
        return Slot(self._next, self.stamp_ns(self._next))

    def read(self) -> Image | None:
        """The next frame; None at the end."""
        slot = self.peek()
        if slot is None:
            return None
        self._next += 1
        return self.image(slot.index)

    def skip(self) -> bool:
        """Passes over a frame, which costs nothing: it never was."""
        self._next += 1
        return self._next <= self.frame_count

    def stamp_ns(self, index: int) -> int:
        """When frame ``index`` is taken: the middle of its exposure, a rolling shutter's middle row's."""
        return at_rate(index, self.options.rate)

    def image(self, index: int) -> Image:
        """Frame ``index`` (0 or more), in any order."""
        renderer, sensor = self._opened()
        stamp = self.stamp_ns(index)
        exposure = sensor.exposure(stamp * 1e-9)
        walkers = walkers_at(self._walkers, stamp * 1e-9)
        picture = renderer.draw(self.path.pose(exposure.seconds), walkers)
        depths = self.depth(index) if sensor.readout_s else None
        return Image(index, stamp, sensor.take(picture.pixels, index, exposure, picture.depth, depths))

    def depth(self, index: int) -> F32:
        """Exact depth (h, w) of frame ``index``, metres along the optical axis, at pixel centres."""
        renderer, _ = self._opened()
        return renderer.depth(self.pose(index), walkers_at(self._walkers, self.stamp_ns(index) * 1e-9))

    def pose(self, index: int) -> Array:
        """Exact world_from_camera (4, 4) of frame ``index``; world: metres, z up, on the floor."""
        return self.path.pose(self.stamp_ns(index) * 1e-9)

    def true_pose(self, index: int) -> Array:
        """See :meth:`pose`."""
        return self.pose(index)

    def truth(self) -> tuple[I64, Array]:
        """Stamps (n,) in nanoseconds and world_from_camera (n, 4, 4) of all frames, for scorers."""
        stamps = np.array([self.stamp_ns(k) for k in range(self.frame_count)], dtype=np.int64)
        return stamps, np.array([self.pose(k) for k in range(self.frame_count)])

    def _opened(self) -> tuple[Renderer, Sensor]:
        if not self._is_open or self._renderer is None or self._sensor is None:
            raise SourceError(f"{self.name} is not open")
        return self._renderer, self._sensor


def _world(plan: Plan, options: Options) -> World:
    if options.kind == CORRIDOR:
        return corridor.build(plan, options.seed, options.unlike)
    if options.kind == STAIRS:
        return stairs.build(plan, options.seed, options.unlike)
    return (streets.build_streets if options.kind in OUTDOORS else build_world)(plan, options.seed)


def _plan_and_path(options: Options) -> tuple[Plan, CameraPath]:
    if options.follow:
        way = Followed(named_path(options.follow), options.speed)
        plan = room_about((way.high - way.low)[:2], way.ceiling, options.seed)
        assert plan.zone is not None
        way.place(plan.zone.mean(axis=0))
        return plan, way
    if options.kind == CORRIDOR:
        plan = corridor.make_plan(options.seed)
        return plan, corridor.make_path(plan, options.speed, options.seed)
    if options.kind == STAIRS:
        return stairs.make_plan(options.seed), stairs.make_path(options.speed, options.seed)
    if options.kind == TOWN:
        plan = streets.make_town(options.seed)
    elif options.kind in OUTDOORS:
        plan = streets.make_plan(options.seed)
    else:
        plan = make_plan(options.several_rooms, options.seed)
    return plan, make_path(plan, options.path, options.speed, options.seed)
