"""The system calls that capturing takes, in one place that a test can stand in for."""

from __future__ import annotations

import fcntl
import mmap
import os
import select
from typing import Any


class Kernel:
    """Linux. Every call may raise OSError with the kernel's number."""

    def open(self, path: str) -> int:
        """A descriptor of the device; never blocks."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, fd: int, code: int, argument: Any) -> None:
        """Hands a structure over, which the driver may fill."""
        fcntl.ioctl(fd, code, argument, True)

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """The driver's buffer in our memory."""
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, fd: int, timeout_s: float) -> bool:
        """Whether there is something to take from the queue, be it an error."""
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000.0))

    def close(self, fd: int) -> None:
        """Gives the descriptor back."""
        os.close(fd)
