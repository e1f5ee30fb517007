"""A progress bar on the terminal, or silence where there is none."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars


class Progress:
    """How much of a recording has been played; on stderr, as stdout is for results.

    Where the terminal goes away nothing is shown any more, and what is measured goes on.
    """

    def __init__(self, total: int | None, quiet: bool = False) -> None:
        """``total`` frames, None where nobody knows; ``quiet`` shows nothing."""
        self._bars = Bars(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            disable=quiet or not sys.stderr.isatty(),
            auto_refresh=False,  # a refreshing thread would take time from what is measured
        )
        self._task = self._bars.add_task("playing", total=total)

    def at(self, frames: int) -> None:
        """So many frames are behind us."""
        self._show(lambda: self._bars.update(self._task, completed=frames, refresh=True))

    def say(self, what: str, total: int | None = None) -> None:
        """What is being done now, and of how many where that is another number."""
        self._show(lambda: self._bars.update(self._task, description=what, total=total, refresh=True))

    def __enter__(self) -> Self:
        self._show(self._bars.start)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._show(self._bars.stop)

    def _show(self, draw: Callable[[], None]) -> None:
        try:
            draw()
        except OSError:
            self._bars.disable = True
