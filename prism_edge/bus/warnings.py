"""What a process has to warn of, by subject, so that nobody takes another's warning back."""

from __future__ import annotations


class Warnings:
    """Warnings that stand, as one of the values that `health` shows: all of them, in the order they came."""

    def __init__(self, values: dict[str, str]) -> None:
        """``values`` gets ``warning`` while any stands."""
        self._values = values
        self._standing: dict[str, str] = {}

    def __call__(self, subject: str, words: str) -> None:
        """Warn of ``subject`` in these words in place of those before; without any it is well again."""
        if words:
            self._standing[subject] = words
        else:
            self._standing.pop(subject, None)
        if self._standing:
            self._values["warning"] = "; ".join(self._standing.values())
        else:
            self._values.pop("warning", None)
