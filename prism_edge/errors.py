"""Errors that a user can cause: each ends in one clear line and a documented exit code."""

from __future__ import annotations

import contextlib
import sys
import traceback

# Of sysexits.h: a file or device that fails, and an error of our own.
FAILING_FILE, UNEXPECTED = 74, 70

# That PyYAML raises beside its own: for values that their tags don't fit, and brackets without end.
YAML_MISFITS = (ValueError, LookupError, AttributeError, RecursionError)


class PrismError(Exception):
    """Root of every error that the command line turns into one line."""

    exit_code = 1


class ConfigError(PrismError):
    """A configuration or camera file, or a command-line setting, is wrong."""

    exit_code = 3


class SourceError(PrismError):
    """A camera, video or recording can't be opened or read."""

    exit_code = 4


class ModelError(PrismError):
    """A depth model can't be loaded or breaks its contract."""

    exit_code = 5


class BusError(PrismError):
    """The Zenoh session can't be opened, or a message on it is malformed."""

    exit_code = 6


class SupervisionError(PrismError):
    """A process kept dying and was given up."""

    exit_code = 7


class EvaluationError(PrismError):
    """A run can't be scored, or broke a rule of the evaluation."""

    exit_code = 8


class CalibrationError(PrismError):
    """Views of a board don't give a camera's intrinsics."""

    exit_code = 9


class MapError(PrismError):
    """A stored map can't be read, written or used."""

    exit_code = 10


def in_words(error: PrismError | OSError) -> str:
    """What is wrong, for one line; of a file with its name, where that is known."""
    if isinstance(error, PrismError):
        return str(error)
    file = f"{error.filename}: " if error.filename else ""
    return file + (error.strerror or str(error) or type(error).__name__)


def first_line(error: BaseException, limit: int | None = None) -> str:
    """An exception's first line, or its type where it says nothing; of ``limit`` characters at most."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:limit]


def report(error: Exception) -> int:
    """Says on stderr what ended the program, in one line where a user can mend it; returns the exit code."""
    if isinstance(error, PrismError):
        line, code = in_words(error), error.exit_code
    elif isinstance(error, OSError):  # a full disk, mostly, which may be any of a program's files
        line, code = in_words(error), FAILING_FILE
    else:
        say("".join(traceback.format_exception(error)).rstrip())
        line, code = "unexpected; please report it with the lines above", UNEXPECTED
    say(f"prism-edge: error: {line}")
    return code


def say(line: str) -> None:
    """A line on stderr; where that is closed, full or without a reader there is nobody left to tell."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(line, file=sys.stderr, flush=True)
