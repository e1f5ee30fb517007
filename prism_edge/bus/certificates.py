"""Whether certificate, key and authority belong together: a TLS link's two ends, without a network."""

from __future__ import annotations

import hashlib
import ssl

from prism_edge.config import NetworkConfig
from prism_edge.named_path import named_path

_ROUNDS = 8  # a handshake takes two or three


def mismatch(network: NetworkConfig) -> str:
    """Why nobody who trusts ``network.ca`` would take what is shown to him; empty where he would.

    Shown to clients where ``network.endpoint`` is listened on, else to the listener. The files must be
    readable. Names and what Zenoh asks beyond this are known only once a link is tried.
    """
    if not (network.ca and network.certificate and network.key):
        return ""
    trusting, showing = ssl.PROTOCOL_TLS_CLIENT, ssl.PROTOCOL_TLS_SERVER
    if not network.endpoint:
        trusting, showing = showing, trusting
    judge, shown = ssl.SSLContext(trusting), ssl.SSLContext(showing)
    judge.check_hostname = shown.check_hostname = False
    shown.verify_mode, judge.verify_mode = ssl.CERT_NONE, ssl.CERT_REQUIRED
    judge.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # as Zenoh: whoever is named is trusted, root or not
    certificate, key = str(named_path(network.certificate)), str(named_path(network.key))
    try:
        judge.load_verify_locations(named_path(network.ca))
    except OSError:  # SSLError is one; a folder another
        return f"network.ca: {network.ca} holds no PEM certificate"
    try:
        for context in (shown, judge):  # whoever listens must show something; the judge's own isn't looked at
            context.load_cert_chain(certificate, key, password=lambda: "")  # or it would ask on the terminal
    except OSError as error:  # SSLError is one
        if getattr(error, "reason", "") == "KEY_VALUES_MISMATCH":
            return f"network.key: {network.key} is not the key of {network.certificate}"
        both = f"{network.certificate} and {network.key}"
        return f"network.certificate: {both} are no PEM pair without password"
    refused = _handshake(judge, shown)
    return f"network.ca: {network.ca} does not vouch for {network.certificate} ({refused})" if refused else ""


def contents(network: NetworkConfig) -> dict[str, str]:
    """A digest of each file that is named, by its key; empty where it can't be read."""
    named = {f"network.{key}": getattr(network, key) for key in ("ca", "certificate", "key")}
    return {key: _digest(name) for key, name in named.items() if name}


def _digest(name: str) -> str:
    try:
        return hashlib.sha256(named_path(name).read_bytes()).hexdigest()
    except OSError:
        return ""


def _handshake(judge: ssl.SSLContext, shown: ssl.SSLContext) -> str:
    """What the judge has against the other's certificate; empty: nothing."""
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    judge_listens = judge.protocol == ssl.PROTOCOL_TLS_SERVER
    ends = [
        judge.wrap_bio(there, back, server_side=judge_listens),
        shown.wrap_bio(back, there, server_side=not judge_listens),
    ]
    for _ in range(_ROUNDS):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                pass
            except ssl.SSLCertVerificationError as error:
                return error.verify_message
            except ssl.SSLError as error:
                return error.reason or str(error)
    return ""
