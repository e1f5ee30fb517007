"""The five processes: thin shells that join a pure core to the bus."""

from __future__ import annotations

import os

# One thread each: the camera-rate path shares few cores with the solvers. BLAS reads this when NumPy loads.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
