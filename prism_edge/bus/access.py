"""Who may do what over the robot's network: Zenoh's access control and TLS (docs/SECURITY.md).

This host's own processes may do everything. The network may read public topics; a certificate named as an
operator may command too; one named as a remote process may say and hear what that process does. All else is
refused, internal topics before everything.
"""

from __future__ import annotations

import os
from typing import Any

from prism_edge.bus.keys import check_endpoint, collide, protocol_of
from prism_edge.config import NetworkConfig
from prism_edge.errors import ConfigError
from prism_edge.named_path import named_path
from prism_edge.processes import PROCESSES
from prism_edge.topics import COMMANDS, TOPICS

SECURE = ("tls", "quic")
_HEAR = {"ingress": ["declare_subscriber", "query"], "egress": ["put", "reply", "declare_queryable"]}
_SAY = {"ingress": ["put", "reply", "declare_queryable"], "egress": ["declare_subscriber", "query"]}
_SEE_TOKENS = {
    "ingress": ["declare_liveliness_subscriber", "liveliness_query"],
    "egress": ["liveliness_token"],
}
_HOLD_TOKENS = {
    "ingress": ["liveliness_token"],
    "egress": ["declare_liveliness_subscriber", "liveliness_query"],
}
_ASK = {"ingress": ["query"], "egress": ["reply", "declare_queryable"]}
_KINDS = (_HEAR, _SAY, _SEE_TOKENS, _HOLD_TOKENS)
_EVERYTHING = sorted({message for kind in _KINDS for messages in kind.values() for message in messages})


def check_network(network: NetworkConfig, bus: str) -> None:
    """Whether the settings can be here, beside the endpoint of the bus.

    ConfigError names what can't, BusError a malformed endpoint.
    """
    check_settings(network, bus)
    check_files(network)


def check_files(network: NetworkConfig) -> None:
    """Raises ConfigError that names a file which this process can't read."""
    for problem in unreadable(network):
        raise ConfigError(problem)


def unreadable(network: NetworkConfig) -> list[str]:
    """A line for each file that is named and can't be read by this process."""
    files = {key: getattr(network, key) for key in ("ca", "certificate", "key")}
    return [
        f"network.{key}: can't read {path}"
        for key, path in files.items()
        if path and not os.access(named_path(path), os.R_OK)
    ]


def check_settings(network: NetworkConfig, bus: str) -> None:
    """Whether the settings can be, whatever files are there; raises as :func:`check_network` does."""
    if network.endpoint:
        check_endpoint(network.endpoint, "network.endpoint")
        if collide(bus, network.endpoint):
            raise ConfigError(f"network.endpoint: the bus has its port already ({bus}): take another")
        if protocol_of(bus) not in _OURS:  # what no rule allows: heartbeats too would be refused
            raise ConfigError(
                f"bus.endpoint: {bus}: beside network.endpoint the robot's own processes link by "
                f"{' or '.join(f'{protocol}/' for protocol in _OURS)} alone"
            )
    secure = protocol_of(network.endpoint) in SECURE
    if network.operators and not secure:
        raise ConfigError("network.operators: only a tls/ network.endpoint asks for certificates")
    for name in network.remote:
        if name not in PROCESSES or name == "source":
            able = ", ".join(p for p in PROCESSES if p != "source")
            raise ConfigError(f"network.remote: {name!r} can't run elsewhere; one of {able} can")
    if network.remote and not network.endpoint:
        raise ConfigError("network.remote: needs network.endpoint, where the other host is to connect")
    if bool(network.certificate) != bool(network.key):
        raise ConfigError("network.certificate and network.key belong together: set both or none")
    if secure and not (network.certificate and network.ca):
        raise ConfigError("network.endpoint: TLS needs network.ca, network.certificate and network.key")


def tls(network: NetworkConfig) -> dict[str, Any]:
    """Zenoh's settings for TLS: both ends show a certificate of the lab's authority."""
    if not network.ca:
        return {}
    settings: dict[str, Any] = {
        "root_ca_certificate": str(named_path(network.ca)),
        "enable_mtls": bool(network.certificate),
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    if network.certificate:
        for side in ("listen", "connect"):
            settings[f"{side}_certificate"] = str(named_path(network.certificate))
            settings[f"{side}_private_key"] = str(named_path(network.key))
    return {"transport/link/tls": settings}


# All public topics and nothing else: internal ones, tokens and commands have a chunk more. In one rule, since
# who asks for `prism/robot/*` is let in where one rule holds all of that.
_PUBLIC = "prism/*/*"

# Loopback by TCP, as our own processes link: a TLS client on this host is as good as its certificate.
_HERE: list[dict[str, Any]] = [
    {"id": "here", "interfaces": ["lo"], "link_protocols": ["tcp"]},
    {"id": "here by socket", "link_protocols": ["unixsock-stream"]},
]

_OURS = [protocol for subject in _HERE for protocol in subject["link_protocols"]]


def access_control(network: NetworkConfig, listener: bool) -> dict[str, Any]:
    """Zenoh's rules for the listener, or for the other processes; none where no network may connect.

    The listener tells the processes of every peer, and they link to it of their own accord (gossip): what
    a peer on the network would hear from them directly is refused altogether.
    """
    if not network.endpoint:
        return {}
    everything = _rule("everything", _EVERYTHING, ["**"], ["ingress", "egress"])
    ours = {"subjects": [subject["id"] for subject in _HERE], "rules": ["everything"]}
    if not listener:
        return _deny_but([everything], _HERE, [ours])
    rules: list[dict[str, Any]] = [
        everything,
        *_rules("read", _HEAR, [_PUBLIC]),
        *_rules("presence", _SEE_TOKENS, ["prism/*/alive/*"]),
        *_rules("command", _ASK, ["prism/*/command/*"]),
    ]
    subjects = [*_HERE, {"id": "anybody"}]
    reading = [rule["id"] for rule in rules if rule["id"].startswith(("read", "presence"))]
    policies = [
        ours,
        {"subjects": ["anybody"], "rules": reading},
    ]
    if network.operators:
        subjects.append({"id": "operators", "cert_common_names": list(network.operators)})
        commanding = [rule["id"] for rule in rules if rule["id"].startswith("command")]
        policies.append({"subjects": ["operators"], "rules": commanding})
    for process in network.remote:
        own = _of_process(process)
        rules += own
        by_name = {"cert_common_names": [process]} if protocol_of(network.endpoint) in SECURE else {}
        subjects.append({"id": f"remote {process}", **by_name})
        policies.append({"subjects": [f"remote {process}"], "rules": [rule["id"] for rule in own]})
    return _deny_but(rules, subjects, policies)


def _of_process(process: str) -> list[dict[str, Any]]:
    """What one process hears and says, and the commands that it answers, by the tables of both."""
    hears = [t.key for t in TOPICS.values() if process in t.consumers]
    says = [t.key for t in TOPICS.values() if t.producer == process]
    says += [command.key for command in COMMANDS.values() if command.process == process]
    tokens = [f"prism/*/{held}/{process}" for held in ("alive", "internal/ready")]
    of_all = [f"prism/*/{t.key}" for t in TOPICS.values() if t.of_all]
    # In nobody else's name; but who listens, listens to all of them.
    own, listened = [f"{key}/{process}" for key in of_all], [f"{key}/*" for key in of_all]
    return [
        _rule(f"{process} says of itself", _SAY["ingress"], own, ["ingress"]),
        _rule(f"{process} is listened to", _SAY["egress"], listened, ["egress"]),
        *_rules(f"{process} hears", _HEAR, [f"prism/*/{key}" for key in hears]),
        *_rules(f"{process} says", _SAY, [f"prism/*/{key}" for key in says]),
        *_rules(f"{process} sees", _SEE_TOKENS, ["prism/*/internal/ready/*", "prism/*/internal/run/*"]),
        *_rules(f"{process} is", _HOLD_TOKENS, tokens),
    ]


def _deny_but(rules: list[Any], subjects: list[Any], policies: list[Any]) -> dict[str, Any]:
    lists = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"access_control": {"enabled": True, "default_permission": "deny", **lists}}


def _rules(name: str, messages: dict[str, list[str]], keys: list[str]) -> list[dict[str, Any]]:
    return [_rule(f"{name} {flow}", kinds, keys, [flow]) for flow, kinds in messages.items() if keys]


def _rule(name: str, messages: list[str], keys: list[str], flows: list[str]) -> dict[str, Any]:
    return {"id": name, "messages": messages, "flows": flows, "permission": "allow", "key_exprs": keys}
