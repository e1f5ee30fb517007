"""Two processes of one name: those of another daemon that is called as this one, or a worker begun twice."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prism_edge.messages import Heartbeat

SURE_S = 10.0  # heard by turns for so long
GONE_S = 5.0


class Namesakes:
    """Told of each heartbeat. A process that is started again has another pid and keeps it; two are heard by
    turns, and where both have one pid, as containers on two hosts may, their clocks go back at every turn.
    Containers of one host, whose pids are alike, can't be told apart: they have one clock."""

    def __init__(self) -> None:
        self._latest: dict[str, tuple[int, int]] = {}  # pid and clock of the last heartbeat
        self._former: dict[str, set[int]] = {}  # pids that another one has followed
        self._turns: dict[str, tuple[float, float]] = {}  # when the first, and the last, was taken

    def heard(self, beat: Heartbeat, now_s: float) -> None:
        """``now_s`` is on the clock of all other times here."""
        pid, clock_ns = self._latest.get(beat.process, (beat.pid, 0))
        self._latest[beat.process] = beat.pid, beat.monotonic_ns
        former = self._former.setdefault(beat.process, set())
        if beat.pid == pid:
            is_turn = beat.monotonic_ns < clock_ns
        else:
            is_turn = beat.pid in former
            former.add(pid)
        if is_turn:
            first_s, last_s = self._turns.get(beat.process, (now_s, now_s))
            self._turns[beat.process] = (first_s if now_s - last_s <= GONE_S else now_s), now_s

    def there(self, now_s: float) -> list[str]:
        """The processes of which there are two; once that is sure of one, all that are heard by turns."""
        turns = {name: span for name, span in self._turns.items() if now_s - span[1] <= GONE_S}
        sure = any(last_s - first_s >= SURE_S for first_s, last_s in turns.values())
        return list(turns) if sure else []


def words(robot: str, processes: list[str]) -> str:
    """What is to be said of them."""
    return (
        f"name {robot!r} is another's, too: {', '.join(processes)} heard from two at once, and each takes in "
        "what is the other's; give every robot a name of its own (robot), and start each worker once"
    )
