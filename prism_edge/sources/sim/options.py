"""The address of a simulated sequence, ``sim:KIND?option=value&...``, checked (docs/SIMULATOR.md)."""

from __future__ import annotations

from dataclasses import dataclass

from prism_edge.config import limits, one_of, text
from prism_edge.errors import SourceError
from prism_edge.sources.address import parse_options

SCHEME = "sim:"
STREET, TOWN = "street", "town"
OUTDOORS = (STREET, TOWN)
CORRIDOR, STAIRS = "corridor", "stairs"
REPEATED = (CORRIDOR, STAIRS)
KINDS = ("room", "loop", "static", *OUTDOORS, *REPEATED)
HANDHELD, WHEELED, STOPS, TURN, STILL = "handheld", "wheeled", "stops", "turn", "still"
DRIVE = "drive"
INDOORS_MPS = 5.0


@dataclass(frozen=True)
class Options:
    """What a ``sim:`` address says. 0 stands for 'as the kind and path have it' where noted."""

    kind: str = one_of("room", *KINDS, help="world: rooms, streets, a corridor, stairs")
    seed: int = limits(0, 0, 2**31 - 1, "the world, the way and the noise; equal seeds, equal pictures")
    frames: int = limits(0, 0, 100_000_000, "length; 0: 900, or one lap of a closed way and a little more")
    path: str = one_of(HANDHELD, HANDHELD, WHEELED, STOPS, TURN, STILL, DRIVE, help="how the camera moves")
    rate: float = limits(30.0, 0.1, 1000.0, "frames a second")
    width: int = limits(640, 32, 4096, "pixels of a row, even")
    height: int = limits(480, 32, 4096, "rows, even")
    focal: float = limits(0.0, 0.0, 20_000.0, "focal length in pixels; 0: 525 at a width of 640")
    speed: float = limits(0.0, 0.0, 20.0, "metres a second; 0: as is usual on that path")
    actors: int = limits(0, 0, 3, "people who walk about")
    noise: float = limits(1.0, 0.0, 10.0, "sensor noise, times 2.5 grey levels; 0: none")
    blur: float = limits(1.0, 0.0, 10.0, "exposure time that smears motion, times 8 ms; 0: none")
    exposure: float = limits(1.0, 0.0, 3.0, "changes of exposure, times half a stop; 0: none")
    readout: float = limits(0.0, -100.0, 100.0, "ms from the first row to the last; 0: all at once")
    unlike: float = limits(0.3, 0.0, 1.0, "how much a step, or stretch of corridor, differs from the next")
    follow: str = text("", "a TUM file (metres, z up, camera optical) whose way the camera goes, in a room")

    @property
    def several_rooms(self) -> bool:
        """Whether the world is the ring of rooms."""
        return self.kind == "loop"

    @property
    def focal_length(self) -> float:
        """Focal length in pixels."""
        return self.focal or 525.0 * self.width / 640.0


def is_simulated(uri: str) -> bool:
    """Whether an address is one of ours."""
    return uri.startswith(SCHEME)


def parse(uri: str) -> Options:
    """The options of an address; raises SourceError, in one line, for anything that it can't mean."""
    kind, _, query = uri.removeprefix(SCHEME).partition("?")
    if kind not in KINDS:
        raise SourceError(f"{uri}: no simulated world is called {kind!r}; there are {', '.join(KINDS)}")
    values = {"kind": kind} | parse_options(uri, query, Options, without=("kind",))
    if "follow" in values and kind != "room":
        raise SourceError(f"{uri}: follow leads through a room, not through {kind}; use room")
    if "follow" in values and ("path" in values or "actors" in values):
        raise SourceError(f"{uri}: follow is the whole way, with nobody in it; leave out path and actors")
    if kind == "static" and values.setdefault("path", STILL) != STILL:
        raise SourceError(f"{uri}: the camera of static stands still; use room for path={values['path']}")
    if kind in OUTDOORS and values.setdefault("path", DRIVE) != DRIVE:
        raise SourceError(f"{uri}: the camera of {kind} is on a car; path={values['path']} is for rooms")
    if kind in REPEATED and values.get("path", HANDHELD) != HANDHELD:
        raise SourceError(f"{uri}: somebody carries the camera in {kind}; leave out path={values['path']}")
    if "unlike" in values and kind not in REPEATED:
        raise SourceError(f"{uri}: unlike is for what comes again and again; use {' or '.join(REPEATED)}")
    options = Options(**values)
    if options.path == DRIVE and kind not in OUTDOORS:
        raise SourceError(f"{uri}: path=drive needs room for a car; use street")
    if options.actors and kind in (*OUTDOORS, *REPEATED):
        raise SourceError(f"{uri}: nobody walks in {kind}; actors are for rooms")
    if options.speed > INDOORS_MPS and kind not in OUTDOORS:
        raise SourceError(f"{uri}: speed is at most {INDOORS_MPS:g} indoors, not {options.speed:g}")
    if options.path == STOPS and options.several_rooms:
        raise SourceError(f"{uri}: path=stops keeps to one room; use room, or path=wheeled")
    if options.width % 2 or options.height % 2:
        raise SourceError(f"{uri}: width and height must be even, not {options.width}x{options.height}")
    if options.speed and options.path in (TURN, STILL):
        raise SourceError(f"{uri}: speed has no meaning with path={options.path}")
    return options
