"""A TCP relay whose link can be slow, lossy or dead, where the kernel can't emulate such a network.

    python tools/faults_relay.py LISTEN_HOST:PORT TARGET_HOST:PORT [--delay S] [--loss SHARE]

Loss is what TCP makes of a lost packet: everything behind it waits for a retransmission.
"""

from __future__ import annotations

import argparse
import contextlib
import queue
import random
import socket
import threading
import time

PACKET = 1400  # bytes
RETRANSMISSION_S = 0.2  # Linux's least timeout
_BEHIND = 4096  # pieces that wait at most in one direction; then the sender is held back


class Relay:
    """Carries connections from ``here`` to ``there`` until closed; a context manager.

    ``delay_s`` and ``loss`` (a share of the packets) may change at any time. While ``gone`` is set,
    connections are closed and new ones end at once.
    """

    def __init__(
        self, here: tuple[str, int], there: tuple[str, int], delay_s: float = 0.0, loss: float = 0.0
    ) -> None:
        self.delay_s, self.loss = delay_s, loss
        self._there, self._gone, self._random = there, False, random.Random(0)
        self._lock = threading.Lock()
        self._ends: set[socket.socket] = set()
        self._server = socket.create_server(here)
        self.port = int(self._server.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def gone(self) -> bool:
        """Whether the other end is away."""
        return self._gone

    @gone.setter
    def gone(self, value: bool) -> None:
        self._gone = value
        if value:
            self._hang_up()

    def __enter__(self) -> Relay:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.close()
        self._hang_up()

    def _hang_up(self) -> None:
        with self._lock:
            ends, self._ends = self._ends, set()
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self) -> None:
        while True:
            try:
                here, _ = self._server.accept()
            except OSError:
                return
            try:
                if self._gone:
                    raise OSError
                there = socket.create_connection(self._there, timeout=5.0)
            except OSError:
                here.close()
                continue
            there.settimeout(None)
            for end in (here, there):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._ends |= {here, there}
            for source, sink in ((here, there), (there, here)):
                pieces: queue.Queue[tuple[float, bytes]] = queue.Queue(_BEHIND)
                threading.Thread(target=self._hear, args=(source, pieces), daemon=True).start()
                threading.Thread(target=self._say, args=(sink, pieces), daemon=True).start()

    def _hear(self, source: socket.socket, pieces: queue.Queue[tuple[float, bytes]]) -> None:
        data = b"-"
        while data:
            try:
                data = source.recv(65536)
            except OSError:
                data = b""
            due = time.monotonic() + self.delay_s
            if self.loss and self._random.random() > (1.0 - self.loss) ** (len(data) / PACKET):
                due += RETRANSMISSION_S
            pieces.put((due, data))

    def _say(self, sink: socket.socket, pieces: queue.Queue[tuple[float, bytes]]) -> None:
        while True:
            due, data = pieces.get()
            time.sleep(max(due - time.monotonic(), 0.0))  # in order: nothing overtakes a retransmission
            try:
                if data:
                    sink.sendall(data)
                    continue
                sink.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass
            with self._lock:
                self._ends.discard(sink)
            sink.close()
            while data:  # let the other thread end
                data = pieces.get()[1]
            return


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    return host, int(port)


def main() -> None:
    """Relay until killed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("listen", type=_address)
    parser.add_argument("target", type=_address)
    parser.add_argument("--delay", type=float, default=0.0, help="seconds, each way")
    parser.add_argument("--loss", type=float, default=0.0, help="share of packets of 1400 bytes")
    args = parser.parse_args()
    with Relay(args.listen, args.target, args.delay, args.loss):
        print("ready", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
