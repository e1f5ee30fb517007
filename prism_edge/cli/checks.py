"""What `prism-edge doctor` looks at: each check is one function that returns its lines."""

from __future__ import annotations

import contextlib
import glob
import importlib
import importlib.metadata
import json
import os
import platform
import resource
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from prism_edge.config import Config
from prism_edge.errors import MapError, PrismError, first_line

OK, WARN, FAIL = "ok", "warn", "fail"

# Wheels with native code: module, distribution. Loading them is the test.
NATIVE = {
    "numpy": "numpy",
    "cv2": "opencv-python-headless",
    "onnxruntime": "onnxruntime",
    "gtsam": "gtsam",
    "zenoh": "eclipse-zenoh",
    "rosbags": "rosbags",
    "yaml": "pyyaml",
    "psutil": "psutil",
    "setproctitle": "setproctitle",
}
LEAST_MEMORY_MB, LEAST_DISK_MB = 700, 500
TRIED_BYTES = 16 << 10
LOCKED_FOR_SHARED_MEMORY = 64 << 20


@dataclass(frozen=True)
class Finding:
    """One line of the report; ``advice`` says what to do about it."""

    level: str
    subject: str
    found: str
    advice: str = ""


def check_python() -> Iterator[Finding]:
    """The interpreter and the machine it runs on."""
    yield Finding(OK, "python", f"{platform.python_version()} on {platform.system()} {platform.machine()}")


def check_cpu() -> Iterator[Finding]:
    """Cores that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores < 2:
        yield Finding(WARN, "cpu", "1 core", "two are wanted: expect dropped frames")
    else:
        yield Finding(OK, "cpu", f"{cores} cores")


def check_wheels(modules: dict[str, str] = NATIVE) -> Iterator[Finding]:
    """Whether each native library loads, and its version."""
    for module, distribution in modules.items():
        try:
            importlib.import_module(module)
            yield Finding(OK, distribution, importlib.metadata.version(distribution))
        except importlib.metadata.PackageNotFoundError:
            yield Finding(OK, distribution, "loads (version not recorded)")
        except Exception as error:  # a broken wheel may raise anything
            line = " ".join(str(error).split()) or type(error).__name__
            yield Finding(FAIL, distribution, line[:160], f"pip install --force-reinstall {distribution}")


def check_extras(config: Config) -> Iterator[Finding]:
    """Whether the optional dependencies that the configuration takes are installed."""
    try:
        from prism_edge.cli.check import extras
    except Exception:  # a wheel that doesn't load, said by check_wheels
        return
    for line in extras(config):
        yield Finding(FAIL, "extras", line)


def check_providers(config: Config) -> Iterator[Finding]:
    """The execution providers that the configuration asks for, and that one onnxruntime alone has them."""
    installed = sorted(set(importlib.metadata.packages_distributions().get("onnxruntime", [])))
    if len(installed) > 1:
        advice = "they overwrite each other: uninstall all, then install one (docs/MODELS.md)"
        yield Finding(FAIL, "providers", f"{' and '.join(installed)} are both installed", advice)
    if "depth" in config.network.remote:
        return
    try:
        import onnxruntime

        from prism_edge.depth.providers import full_name, short_name
    except Exception:  # said by check_wheels
        return
    available = onnxruntime.get_available_providers()
    yield Finding(OK, "providers", " ".join(short_name(name) for name in available))
    for name in config.depth.providers:
        try:
            if full_name(name) not in available:
                advice = "install an onnxruntime that has it (docs/MODELS.md), or set depth.providers"
                level = FAIL if name in config.depth.required else WARN
                yield Finding(level, "providers", f"{name} is configured but not there", advice)
        except PrismError as error:
            yield Finding(FAIL, "providers", str(error))


def check_model(config: Config) -> Iterator[Finding]:
    """Whether the configured network loads, keeps its contract and runs."""
    if not config.depth.network:
        yield Finding(WARN, "model", "none given", "without --model there are no poses: depth begins the map")
        return
    if "depth" in config.network.remote:
        yield Finding(OK, "model", f"{config.depth.network} runs on another host (network.remote)")
        return
    try:
        from prism_edge.workers.sensor_network import open_depth
    except Exception as error:  # what is broken may be no wheel of those that check_wheels looks at
        yield Finding(FAIL, "model", f"can't be looked at: {first_line(error, 160)}")
        return
    try:
        network = open_depth(config)
        yield Finding(OK, "model", f"{network.name} on {network.provider}")
    except PrismError as error:
        yield Finding(FAIL, "model", str(error), "see `prism-edge models list`")


def check_zenoh(config: Config) -> Iterator[Finding]:
    """A message there and back over a loopback session of our own, and whether the endpoint is right."""
    try:
        import zenoh

        from prism_edge.bus.keys import check_endpoint, check_robot_name

        check_robot_name(config.robot)
        check_endpoint(config.bus.endpoint)
        seconds = _round_trip(zenoh)
    except PrismError as error:
        yield Finding(FAIL, "zenoh", str(error))
    except Exception as error:  # ZError, or a wheel that does not load
        line = " ".join(str(error).split())[:160]
        yield Finding(FAIL, "zenoh", line, "is loopback networking forbidden here?")
    else:
        if seconds is None:
            yield Finding(FAIL, "zenoh", "a message over loopback did not arrive", "check the firewall on lo")
        else:
            yield Finding(OK, "zenoh", f"loopback round trip in {seconds * 1e3:.1f} ms")


def check_certificates(config: Config) -> Iterator[Finding]:
    """Whether the network's settings can be, and the files that they name be read and belong together."""
    network = config.network
    if not (network.endpoint or network.ca or network.certificate):
        return
    try:
        from prism_edge.bus.access import check_settings, unreadable
        from prism_edge.bus.certificates import mismatch

        check_settings(network, config.bus.endpoint)
    except PrismError as error:
        yield Finding(FAIL, "network", str(error))
        return
    except ImportError:  # said by check_wheels
        return
    missing = unreadable(network)
    for line in missing:
        yield Finding(FAIL, "network", line, "run as who is to read it; under systemd see docs/SECURITY.md")
    wrong = "" if missing else mismatch(network)
    if wrong:
        yield Finding(FAIL, "network", wrong, "docs/SECURITY.md: certificates of one authority, at both ends")
    elif not missing:
        yield Finding(OK, "network", network.endpoint or "a client's certificate")


def _round_trip(zenoh: Any) -> float | None:
    """Seconds from put to arrival between two sessions over loopback TCP; None if it did not arrive."""
    from prism_edge.bus.vacancy import free_endpoint

    def settings(**entries: Any) -> Any:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("transport/shared_memory/enabled", "false")  # as the daemon's own
        for key, value in entries.items():
            config.insert_json5(key.replace("__", "/"), json.dumps(value))
        return config

    endpoint = free_endpoint()
    arrived = threading.Event()
    listening = settings(mode="peer", listen__endpoints=[endpoint])
    connecting = settings(mode="client", connect__endpoints=[endpoint])
    with zenoh.open(listening) as here, zenoh.open(connecting) as there:
        subscriber = here.declare_subscriber("prism/doctor", lambda sample: arrived.set())
        deadline = time.monotonic() + 5.0
        try:
            # The declaration travels too: put until it has got through.
            while time.monotonic() < deadline:
                start = time.monotonic()
                there.put("prism/doctor", b"ping")
                if arrived.wait(0.2):
                    return time.monotonic() - start
        finally:
            subscriber.undeclare()
    return None


def check_limits() -> Iterator[Finding]:
    """Resource limits: memory that may be locked, open files."""
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    shown = "unlimited" if locked == resource.RLIM_INFINITY else f"{locked >> 10} KiB"
    if locked != resource.RLIM_INFINITY and locked < LOCKED_FOR_SHARED_MEMORY:
        shown += ": too little for Zenoh's shared memory, which is off here and not needed"
    yield Finding(OK, "memlock", shown)
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if files != resource.RLIM_INFINITY and files < 256:
        yield Finding(WARN, "files", f"{files} may be open at once", "raise it: ulimit -n 1024")
    else:
        yield Finding(OK, "files", f"{files} may be open at once")


def check_memory(least_mb: int = LEAST_MEMORY_MB, cgroup: Path = Path("/sys/fs/cgroup")) -> Iterator[Finding]:
    """Memory that is free for use: of a container no more than it may take."""
    try:
        import psutil

        free_mb = psutil.virtual_memory().available >> 20
    except Exception:  # said by check_wheels
        return
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # version 2, version 1
        with contextlib.suppress(OSError, ValueError):  # not there, or "max"
            free_mb = min(free_mb, int((cgroup / name).read_text()) >> 20)
    if free_mb < least_mb:
        yield Finding(WARN, "memory", f"{free_mb} MB available", f"the daemon takes up to {least_mb} MB")
    else:
        yield Finding(OK, "memory", f"{free_mb} MB available")


def check_disk(least_mb: int = LEAST_DISK_MB) -> Iterator[Finding]:
    """Space where runs are written, and whether temporary files can be."""
    free_mb = shutil.disk_usage(".").free >> 20
    if free_mb < least_mb:
        yield Finding(WARN, "disk", f"{free_mb} MB free here", "make room before recording runs")
    else:
        yield Finding(OK, "disk", f"{free_mb} MB free here")
    try:
        with tempfile.TemporaryFile():
            pass
    except OSError as error:
        found = f"no temporary files: {error.strerror}"
        yield Finding(FAIL, "disk", found, "set TMPDIR to a writable folder")


def check_folders(config: Config) -> Iterator[Finding]:
    """Whether the daemon could write the files of a run, and what it keeps between runs."""
    try:
        from prism_edge.supervisor.run_directory import default_parent
        from prism_edge.workers.state_directory import kept_journal, state_directory
    except Exception as error:  # as in check_model
        yield Finding(FAIL, "disk", f"a run's folders can't be looked at: {first_line(error, 160)}")
        return
    try:
        run = default_parent()
    except OSError:  # no temporary files: said by check_disk
        return
    advice = "make room, or name another: TMPDIR, XDG_RUNTIME_DIR"
    yield _writable(run, "a run's files", Finding(FAIL, "disk", "", advice))
    advice = "make room, or set state.directory; the service writes there as a user of its own"
    otherwise = Finding(WARN, "disk", "", advice)
    try:
        kept = state_directory(config.state)
    except MapError as error:
        yield replace(otherwise, found=str(error))
        return
    what = "maps and journal" if kept_journal(config.state) else "maps"
    yield _writable(kept, what, otherwise)


def _writable(folder: Path, what: str, otherwise: Finding) -> Finding:
    there = next(path for path in (folder, *folder.parents) if os.path.exists(path))
    try:
        with tempfile.TemporaryFile(dir=there) as file:
            file.write(bytes(TRIED_BYTES))
    except OSError as error:
        return replace(otherwise, found=f"{what} can't be written to {folder}: {error.strerror}")
    return Finding(OK, "disk", f"{what} can be written to {folder}")


def check_cameras(pattern: str = "/dev/video*") -> Iterator[Finding]:
    """Video devices, and whether they may be opened."""
    devices = sorted(glob.glob(pattern))
    denied = [device for device in devices if not os.access(device, os.R_OK | os.W_OK)]
    if denied:
        advice = "add yourself to the group video: sudo usermod -aG video $USER"
        yield Finding(WARN, "cameras", f"no access to {' '.join(denied)}", advice)
    elif devices:
        yield Finding(OK, "cameras", " ".join(devices))
    else:
        yield Finding(OK, "cameras", "no video device; recordings need none")


def all_checks(config: Config) -> Iterator[Callable[[], Iterator[Finding]]]:
    """Every check, in the order of the report."""
    yield check_python
    yield check_cpu
    yield check_wheels
    yield lambda: check_extras(config)
    yield lambda: check_providers(config)
    yield lambda: check_model(config)
    yield lambda: check_zenoh(config)
    yield lambda: check_certificates(config)
    yield check_limits
    yield check_memory
    yield check_disk
    yield lambda: check_folders(config)
    yield check_cameras
