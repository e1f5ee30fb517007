"""Sets a camera up as asked, reads everything back, and refuses what is not as asked."""

from __future__ import annotations

from dataclasses import dataclass

from prism_edge.config import limits, one_of
from prism_edge.errors import SourceError
from prism_edge.sources.live import v4l2_abi as abi
from prism_edge.sources.live.v4l2_device import Device, Mode
from prism_edge.sources.live.v4l2_pixels import FORMATS, can_hold

_USUAL_HZ = 30.0
_RATE_TOLERANCE = 0.02
_EXPOSURE_TOLERANCE = 0.1  # sensors count lines
_EXPOSURE_UNITS_A_MS = 10.0


@dataclass(frozen=True)
class Options:
    """What may stand behind ? in a camera's address."""

    width: int = limits(0, 0, 16_384, "pixels of a row; 0: the camera file's")
    height: int = limits(0, 0, 16_384, "rows; 0: the camera file's")
    rate: float = limits(0.0, 0.0, 1000.0, "images a second; 0: 30, or the most it has")
    format: str = one_of("auto", "auto", *FORMATS, help="pixel format; auto: the first with size and rate")
    exposure_ms: float = limits(0.0, 0.0, 10_000.0, "exposure; 0: automatic")
    gain: int = limits(-1, -1, 1_000_000, "gain, in the camera's own unit; -1: as it is")
    focus: int = limits(-1, -1, 1_000_000, "fixed focus, in the camera's own unit; -1: as it is")
    timeout: float = limits(2.0, 0.2, 60.0, "seconds without an image after which it is opened again")
    delay_ms: float = limits(0.0, 0.0, 5000.0, "time from exposure to the kernel's stamp, taken off it")


def choose_mode(device: Device, options: Options) -> Mode:
    """Sets size, format and rate, and returns what was read back; raises SourceError where none fits."""
    offered = device.formats()
    wanted = [name for name in FORMATS if name in offered and options.format in ("auto", name)]
    if not wanted:
        asked = "none that is known here" if options.format == "auto" else f"not {options.format}"
        raise SourceError(f"{device.card} offers the formats {', '.join(offered) or '-'}, {asked}")
    now = device.mode()
    width, height = options.width or now.width, options.height or now.height
    readable = [name for name in wanted if can_hold(name, width, height)]
    if not readable:
        raise SourceError(
            f"{device.card} has {width}x{height} as {', '.join(wanted)} only, which needs an even size"
        )
    found: list[Mode] = []
    fitting: list[Mode] = []  # of those: size and format as asked
    for pixels in readable:
        device.set_format(width, height, pixels)
        device.set_rate(options.rate or _USUAL_HZ)
        mode = device.mode()
        found.append(mode)
        if (mode.width, mode.height, mode.pixels) == (width, height, pixels):
            if _is_fast_enough(mode, options):
                return mode
            fitting.append(mode)
    if fitting and not options.rate:
        best = max(fitting, key=lambda mode: mode.rate_hz)
        device.set_format(width, height, best.pixels)
        device.set_rate(best.rate_hz or _USUAL_HZ)
        found.append(device.mode())
        if found[-1] == best:
            return best
    rate = f" at {options.rate:g} Hz" if options.rate else ""
    gives = "; ".join(f"{m.pixels} {m.width}x{m.height} at {m.rate_hz:.4g} Hz" for m in dict.fromkeys(found))
    raise SourceError(f"{device.card} refuses {width}x{height}{rate}; it made of it: {gives}")


def _is_fast_enough(mode: Mode, options: Options) -> bool:
    if options.rate:
        return abs(mode.rate_hz - options.rate) <= _RATE_TOLERANCE * options.rate
    return mode.rate_hz >= _USUAL_HZ * (1 - _RATE_TOLERANCE)


def set_controls(device: Device, options: Options) -> None:
    """Exposure, gain and focus; raises SourceError for what the camera has not."""
    manual = options.exposure_ms > 0
    modes = (abi.EXPOSURE_MANUAL,) if manual else (abi.EXPOSURE_APERTURE_PRIORITY, abi.EXPOSURE_AUTO)
    if device.control_range(abi.CID_EXPOSURE_AUTO) is not None:
        any(device.set_control(abi.CID_EXPOSURE_AUTO, mode) for mode in modes)
    if device.control_range(abi.CID_EXPOSURE_AUTO_PRIORITY) is not None:
        device.set_control(abi.CID_EXPOSURE_AUTO_PRIORITY, 0)  # else it lowers the rate in the dark
    if manual:
        _set(device, abi.CID_EXPOSURE_ABSOLUTE, round(options.exposure_ms * _EXPOSURE_UNITS_A_MS), "exposure")
    if options.gain >= 0:
        if device.control_range(abi.CID_AUTOGAIN) is not None:
            device.set_control(abi.CID_AUTOGAIN, 0)
        _set(device, abi.CID_GAIN, options.gain, "gain")
    if options.focus >= 0:
        if device.control_range(abi.CID_FOCUS_AUTO) is not None:
            device.set_control(abi.CID_FOCUS_AUTO, 0)
        _set(device, abi.CID_FOCUS_ABSOLUTE, options.focus, "focus")


def _set(device: Device, control: int, value: int, name: str) -> None:
    span = device.control_range(control)
    if span is None:
        raise SourceError(f"{device.card} has no setting for {name}")
    if not span[0] <= value <= span[1]:
        scale = _EXPOSURE_UNITS_A_MS if name == "exposure" else 1.0
        low, high = span[0] / scale, span[1] / scale
        raise SourceError(f"{device.card} takes {name} from {low:g} to {high:g}, not {value / scale:g}")
    device.set_control(control, value)


def check(device: Device, options: Options, mode: Mode) -> None:
    """Reads everything back while images flow; raises SourceError where the camera went its own way."""
    now = device.mode()
    if now != mode:
        raise SourceError(f"{device.card} changed its mode from {mode} to {now} by itself")
    asked = {
        "exposure": (abi.CID_EXPOSURE_ABSOLUTE, options.exposure_ms * _EXPOSURE_UNITS_A_MS or -1),
        "gain": (abi.CID_GAIN, options.gain),
        "focus": (abi.CID_FOCUS_ABSOLUTE, options.focus),
    }
    for name, (control, value) in asked.items():
        if value < 0:
            continue
        found = device.control(control)
        slack = max(1.0, _EXPOSURE_TOLERANCE * value) if name == "exposure" else 0.0
        if abs(found - value) > slack:
            scale = _EXPOSURE_UNITS_A_MS if name == "exposure" else 1.0
            raise SourceError(
                f"{device.card} has {name} {found / scale:g} though it was set to {value / scale:g}"
            )
    has_automatic = options.exposure_ms > 0 and device.control_range(abi.CID_EXPOSURE_AUTO) is not None
    if has_automatic and device.control(abi.CID_EXPOSURE_AUTO) != abi.EXPOSURE_MANUAL:
        raise SourceError(f"{device.card} stays in automatic exposure")
