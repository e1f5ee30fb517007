"""The five processes: thin shells that join a pure core to the bus."""

from __future__ import annotations

import os

# One thread each: the camera-rate path shares few cores with the solvers. Read when the libraries load.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("SPT_NOENV", "1")  # setproctitle writes over the arguments, not /proc/PID/environ too
