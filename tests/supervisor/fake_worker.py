"""A worker that behaves as its command line says: ``fake_worker.py NAME BEHAVIOUR CONFIG PARENT``.

Behaviours, joined by ``+``: steady, ends, dies, raises, refuses, fails_once=FILE (dies the first time),
hangs (declared work that never ends), picky (refuses depth.threads = 13), fragile (dies of it),
stubborn (does not stop),
breeds=FILE (starts a process of its own and writes its id), tracks=WORD (a tracker's odometry),
shows=NAME:VALUE (in its heartbeats), waits=FILE (makes it and is ready; a later life is ready once it
has gone).
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.errors import ModelError
from prism_edge.processes import Process
from prism_edge.workers.launch import run_worker


def main(config: Config, bus: Bus) -> None:
    for behaviour in sys.argv[2].split("+"):
        word, _, value = behaviour.partition("=")
        if word == "refuses":
            bus.pulse.working("loading the network", 60.0)
            time.sleep(1.2)  # heard at work, and yet never ready
            raise ModelError("net.onnx is no ONNX model; give another")
        if word == "picky" and config.depth.threads == 13:
            raise ModelError("13 threads are too many; give fewer")
        if word == "fragile" and config.depth.threads == 13:
            os._exit(9)
        if word == "raises":
            raise RuntimeError("a defect")
        while word == "waits" and Path(value).exists():
            bus.pulse.working("opening the source", 60.0)
            time.sleep(0.02)
        if word == "tracks":
            bus.pulse.values["odometry"] = value
        if word == "shows":
            bus.pulse.values.update([value.split(":", 1)])
        if word == "waits":
            Path(value).touch()  # before it says so: whoever hears that it is ready finds the file
        bus.pulse.ready()
        if word == "dies":
            os._exit(9)
        if word == "fails_once" and not Path(value).exists():
            Path(value).touch()
            os._exit(9)
        if word == "breeds":
            child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
            Path(value).write_text(f"{child.pid}\n")
        if word == "hangs":
            bus.pulse.working("inference", budget_s=0.3)
            time.sleep(60)
        if word == "ends":
            bus.pulse.ended()
        if word == "stubborn":
            time.sleep(60)
    bus.stopped.wait(60)


if __name__ == "__main__":
    name, _, config_file, parent = sys.argv[1:]
    process = Process(name, "fake_worker", "pretends", required=True)
    sys.exit(run_worker(process, config_file, int(parent)))
