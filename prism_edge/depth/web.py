"""One request for a file over http or https: what it may be redirected to, and how it can fail."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from email.message import Message
from typing import Any
from urllib.parse import urlsplit

from prism_edge import __version__
from prism_edge.errors import ModelError

SCHEMES = ("http", "https")
MOST_REDIRECTIONS = 5
UNNAMED = "0"  # the tag of a version that the server does not name
_CHUNK = 1 << 16
_TRANSIENT = {408, 425, 429, 500, 502, 503, 504}


class TransientError(Exception):
    """May be gone the next time."""


class StaleError(Exception):
    """What is here is not the beginning of what the server has."""


class CompleteError(Exception):
    """The server has nothing beyond what is here; the version that it names (:func:`version_tag`)."""


def check_url(url: str) -> None:
    """Raises ModelError for a URL that is not fetched."""
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError:
        raise ModelError(f"{url[:200]!r} is no URL") from None
    if parts.scheme not in SCHEMES or not host or not url.isprintable() or " " in url:
        raise ModelError(f"{url[:200]!r} is no http or https URL")
    if parts.username is not None or parts.password is not None:
        raise ModelError("a URL with a password in it is not fetched: it would be written into logs")


@contextlib.contextmanager
def request(url: str, have: int, stall_s: float) -> Iterator[Any]:
    """The response to a request for the file from byte ``have`` on; it may be all of it (status 200).

    Raises ModelError where asking again is of no use, else one of the errors above.
    """
    headers = {"User-Agent": f"prism-edge/{__version__}", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
    asked = urllib.request.Request(url, headers=headers)
    try:
        response = _opener().open(asked, timeout=stall_s)
    except urllib.error.HTTPError as error:
        error.close()
        if error.code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
            whole = error.headers.get("Content-Range", "") == f"bytes */{have}"
            raise (CompleteError(version_tag(error.headers)) if whole else StaleError) from None
        if error.code in _TRANSIENT:
            raise TransientError(f"the server answers {error.code} {error.reason}") from None
        hint = "; it wants a login: fetch it by hand" if error.code in (401, 403) else ""
        raise ModelError(f"{url}: the server answers {error.code} {_words(error.reason)}{hint}") from None
    except urllib.error.URLError as error:
        if isinstance(error.reason, ssl.SSLCertVerificationError):
            why = error.reason.verify_message
            raise ModelError(f"{url}: the server's certificate is not valid ({why})") from None
        raise TransientError(f"no connection ({_words(error.reason)})") from None
    except TimeoutError:
        raise TransientError("the server does not answer") from None
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise TransientError(f"no sensible answer ({_words(error)})") from None
    with response:
        encoding = response.headers.get("Content-Encoding", "identity")
        if encoding != "identity":
            raise ModelError(f"{url}: the server packs the file ({_words(encoding)}), unasked")
        yield response


class _Redirects(urllib.request.HTTPRedirectHandler):
    max_redirections = MOST_REDIRECTIONS
    max_repeats = 2

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        """Follows from http to https, or to the same scheme, and nowhere else."""
        old, new = urlsplit(req.full_url).scheme, urlsplit(newurl).scheme
        if new not in SCHEMES or (old == "https" and new != "https"):
            fp.close()
            where = f"from {old} to {new or 'nowhere'}"
            raise ModelError(f"{req.full_url}: redirects {where}, which is not followed")
        check_url(newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _opener() -> urllib.request.OpenerDirector:
    """One that knows http and https alone: no files, no FTP."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        urllib.request.UnknownHandler(),
        _Redirects(),
    ):
        opener.add_handler(handler)
    return opener


def version_tag(headers: Message) -> str:
    """Stands for the version of the file that the server names; UNNAMED where it names none."""
    version = headers.get("ETag") or headers.get("Last-Modified") or ""
    return hashlib.sha256(version.encode("utf-8", "replace")).hexdigest()[:12] if version else UNNAMED


def content_range(headers: Message) -> tuple[int, int]:
    """First byte and length in all of ``Content-Range: bytes 5-9/10``."""
    text = headers.get("Content-Range", "")
    try:
        unit, _, rest = text.partition(" ")
        span, _, total = rest.partition("/")
        first, _, last = span.partition("-")
        numbers = int(first), int(last), 0 if total == "*" else int(total)
    except ValueError:
        raise StaleError from None
    if unit != "bytes" or not 0 <= numbers[0] <= numbers[1] or (numbers[2] and numbers[1] != numbers[2] - 1):
        raise StaleError
    return numbers[0], numbers[2] or numbers[1] + 1


def next_chunk(response: Any) -> bytes:
    """What has come next; empty at the end. Raises TransientError."""
    try:
        chunk: bytes = response.read1(_CHUNK)
        return chunk
    except TimeoutError:
        raise TransientError("nothing has come for too long") from None
    except (OSError, http.client.HTTPException) as error:
        raise TransientError(f"the connection broke ({_words(error)})") from None


def _words(error: object) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
