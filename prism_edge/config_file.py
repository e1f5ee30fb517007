"""YAML to the typed configuration and back: every mistake is named with file, line and key."""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
import re
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import yaml

from prism_edge.config import Config
from prism_edge.contradictions import contradictions
from prism_edge.errors import ConfigError

LARGEST_FILE = 1 << 20  # bytes; a configuration is a page or two

# PyYAML follows YAML 1.1, where 1e-8 is text, 010 is eight and 1:30 is ninety; these are what people mean.
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*(_[0-9]+)*)")
_NUMBER = re.compile(r"[-+]?([0-9][0-9_]*\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_TEXT = ("str", "timestamp", "value", "merge")  # tags under which text arrives; none that names a Python type


def load(path: str | os.PathLike[str] | None = None, overrides: Mapping[str, Any] | None = None) -> Config:
    """The defaults, overlaid by the YAML file at ``path`` and then by ``overrides``.

    ``overrides`` maps dotted keys (``"source.uri"``) to values. A value given as text is taken as it
    is where text belongs, and read as YAML elsewhere (``"2"``, ``"[a, b]"``): what a command line needs.
    Raises ConfigError, naming file, line and key, for anything that does not fit the tree.
    """
    given: dict[str, Any] = {} if path is None else _read_file(os.fspath(path))
    for key, value in (overrides or {}).items():
        given[key] = _override(key, value)
    config: Config = _build(Config, given)
    place = "" if path is None else f"{os.fspath(path)}: "
    _check_names(config, place)
    for contradiction in contradictions(config):
        raise ConfigError(place + contradiction)
    return config


def dump(config: Config, explain: bool = False) -> str:
    """YAML that ``load`` reads back as an equal configuration; ``explain`` adds each key's help."""
    lines: list[str] = []
    section = ""
    for leaf in leaves():
        head, _, name = leaf.key.rpartition(".")
        if head != section:
            lines += ([""] if explain else []) + [f"{head}:"]
            section = head
        value = _scalar_text(attrgetter(leaf.key)(config))
        comment = f"  # {leaf.help}" if explain and leaf.help else ""
        lines.append(("  " if head else "") + f"{name}: {value}{comment}")
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Leaf:
    """One key that can be set."""

    key: str  # dotted
    type: Any  # bool, int, float, str, tuple[str, ...] or tuple[float, ...]
    default: Any
    low: float | None = None
    high: float | None = None
    least: float | None = None  # of what is not 0
    choices: tuple[str, ...] = ()
    length: int | None = None  # of a list
    measure: str = ""  # what its numbers are, in a word
    unit: bool = False  # a list whose Euclidean norm is 1, within a per cent
    name: bool = False  # not blank, no slash in front, and unlike its section's other names
    help: str = ""
    reload: tuple[str, ...] = ()  # who takes it up on SIGHUP; nobody: only a restart will do

    @property
    def expects(self) -> str:
        """What belongs here, in words."""
        one = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
        if self.name:
            return "a name"
        if self.type in one:
            beside = "" if self.least is None else "0, or "
            return " or ".join(self.choices) if self.choices else beside + one[self.type] + self._range()
        item = "numbers" if typing.get_args(self.type)[0] is float else "words"
        some = f" (of: {', '.join(self.choices)})" if self.choices else ""
        norm = " of norm 1" if self.unit else ""
        measure = f" ({self.measure})" if self.measure else ""
        count = "" if self.length is None else f"{self.length} "
        return f"a list of {count}{item}{some}{norm}{self._range()}{measure}"

    def _range(self) -> str:
        low = self.low if self.least is None else self.least
        return "" if low is None else f" from {low:.12g} to {self.high:.12g}"


def leaves(tree: type = Config, prefix: str = "", reload: tuple[str, ...] = ()) -> Iterator[Leaf]:
    """Every key of the tree in its order: a section's keys follow one another, plain keys come first."""
    types = typing.get_type_hints(tree)
    fields = [f for f in dataclasses.fields(tree) if f.init]
    for field in sorted(fields, key=lambda f: dataclasses.is_dataclass(types[f.name])):
        kind, key = types[field.name], prefix + field.name
        if dataclasses.is_dataclass(kind):
            assert isinstance(kind, type)
            yield from leaves(kind, key + ".", field.metadata.get("reload", reload))
            continue
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        known = ("low", "high", "least", "choices", "length", "measure", "unit", "name", "help", "reload")
        meta = {k: v for k, v in field.metadata.items() if k in known}
        yield Leaf(key, kind, default, **{"reload": reload, **meta})


_LEAVES = {leaf.key: leaf for leaf in leaves()}
_SECTIONS = {key.rpartition(".")[0] for key in _LEAVES} - {""}


def _build(tree: Any, given: Mapping[str, Any], prefix: str = "") -> Any:
    types = typing.get_type_hints(tree)
    values = {}
    for field in dataclasses.fields(tree):
        key = prefix + field.name
        if dataclasses.is_dataclass(types[field.name]):
            values[field.name] = _build(types[field.name], given, key + ".")
        elif key in given:
            values[field.name] = given[key]
    return tree(**values)


def _check_names(config: Config, place: str) -> None:
    """Raises ConfigError where two names of one section are the same."""
    first: dict[tuple[str, str], str] = {}
    for leaf in _LEAVES.values():
        if not leaf.name:
            continue
        name = attrgetter(leaf.key)(config)
        other = first.setdefault((leaf.key.rpartition(".")[0], name), leaf.key)
        if other != leaf.key:
            raise ConfigError(f"{place}{leaf.key}: is {name!r} like {other}; each needs a name of its own")


def _read_file(path: str) -> dict[str, Any]:
    """Dotted keys and checked values of a file."""
    try:
        with open(path, "rb") as file:
            data = file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise ConfigError(f"{path}: can't read the configuration file: {error.strerror}") from None
    if len(data) > LARGEST_FILE:
        raise ConfigError(f"{path}: larger than {LARGEST_FILE} bytes: this is no configuration file")
    given: dict[str, Any] = {}
    _read_mapping(_compose(data, path), "", given, path)
    return given


def _compose(data: bytes | str, place: str) -> yaml.Node | None:
    try:
        return yaml.compose(data, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"{place}:{mark.line + 1}" if mark is not None and isinstance(data, bytes) else place
        raise ConfigError(f"{line}: not valid YAML: {error.problem or error.context}") from None
    except (yaml.YAMLError, UnicodeError, ValueError) as error:
        raise ConfigError(f"{place}: not valid YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise ConfigError(f"{place}: not valid YAML: nested too deeply") from None


def _read_mapping(node: yaml.Node | None, prefix: str, given: dict[str, Any], path: str) -> None:
    if node is None or (prefix and node.tag == "tag:yaml.org,2002:null"):
        return  # an empty file, or a section whose every line is commented out
    if not isinstance(node, yaml.MappingNode):
        what = f"{prefix[:-1]}: " if prefix else ""
        raise ConfigError(f"{path}:{_line(node)}: {what}expected `key: value` lines, got {_describe(node)}")
    seen: dict[str, int] = {}
    for key_node, value_node in node.value:
        name = key_node.value if isinstance(key_node, yaml.ScalarNode) else _describe(key_node)
        place, key = f"{path}:{_line(key_node)}", prefix + name
        if name in seen:
            raise ConfigError(f"{place}: {key}: set twice; the first is on line {seen[name]}")
        seen[name] = _line(key_node)
        # A dot would let a key reach past its section.
        if "." not in name and key in _SECTIONS:
            _read_mapping(value_node, key + ".", given, path)
        elif "." not in name and key in _LEAVES:
            given[key] = _from_node(_LEAVES[key], value_node, f"{place}: {key}")
        else:
            dotted = f"{key}: unknown key; in a file, write its section and indent the key below it"
            raise ConfigError(f"{place}: {dotted if key in _LEAVES else _unknown(key)}")


def _override(key: str, value: Any) -> Any:
    leaf = _LEAVES.get(key)
    if leaf is None:
        if key in _SECTIONS:
            raise ConfigError(f"setting {key}: this is a section; set one of its keys, such as {_first(key)}")
        raise ConfigError(f"setting {_unknown(key, sections=False)}")
    place = f"setting {key}"
    if isinstance(value, str) and leaf.type is not str:
        node = _compose(value, place)
        if node is None:
            raise ConfigError(f"{place}: expected {leaf.expects}, got nothing")
        return _from_node(leaf, node, place)
    return _checked(leaf, value, place)


def _from_node(leaf: Leaf, node: yaml.Node, place: str) -> Any:
    """The Python value of a YAML node, read as the leaf's type asks for."""
    item = typing.get_args(leaf.type)[0] if typing.get_origin(leaf.type) is tuple else None
    if item is None:
        return _checked(leaf, _scalar(leaf.type, node), place, node)
    if not isinstance(node, yaml.SequenceNode):
        alone = isinstance(node, yaml.ScalarNode) and node.value and leaf.length is None
        hint = f"; write [{node.value}]" if alone and len(node.value) <= 60 else ""
        raise ConfigError(f"{place}: expected {leaf.expects}, got {_describe(node)}{hint}")
    return _checked(leaf, tuple(_scalar(item, child) for child in node.value), place, node)


def _scalar(kind: type, node: yaml.Node) -> Any:
    """What a scalar says; the node itself where it does not say a ``kind``."""
    if not isinstance(node, yaml.ScalarNode):
        return node
    tag, plain = node.tag.removeprefix("tag:yaml.org,2002:"), node.style is None
    if kind is str:
        return node.value if tag in _TEXT else node
    if kind is bool and tag == "bool" and plain:
        return node.value.lower() in ("true", "yes", "on")
    if kind is int and plain and len(node.value) < 100 and _INTEGER.fullmatch(node.value):
        return int(node.value)
    if kind is float and plain and _NUMBER.fullmatch(node.value):
        return float(node.value.replace("_", ""))
    return node


def _checked(leaf: Leaf, value: Any, place: str, node: yaml.Node | None = None) -> Any:
    """``value`` as the leaf's type, in its bounds; ConfigError otherwise."""

    def refuse(found: Any) -> ConfigError:
        # The node shows what was written, such as quotes; an item of a list stands for itself.
        written = node if found is value and not isinstance(found, yaml.Node) and node else found
        return ConfigError(f"{place}: expected {leaf.expects}, got {_describe(written)}")

    if typing.get_origin(leaf.type) is tuple:
        if not isinstance(value, (tuple, list)) or leaf.length not in (None, len(value)):
            raise refuse(value)
        item = typing.get_args(leaf.type)[0]
        values = [_typed(item, one) for one in value]
        for one, given in zip(values, value, strict=True):
            if one is None or (leaf.choices and one not in leaf.choices) or _beyond(leaf, one):
                raise refuse(given)
        if leaf.unit and abs(math.hypot(*values) - 1.0) > 0.01:
            norm = f", of norm {math.hypot(*values):.3g}"
            raise ConfigError(f"{place}: expected {leaf.expects}, got {list(values)}{norm}")
        return tuple(values)
    result = _typed(leaf.type, value)
    nameless = leaf.name and isinstance(result, str) and not (result.strip() and result.isprintable())
    if result is None or nameless or (leaf.choices and result not in leaf.choices):
        raise refuse(value)
    if leaf.name and result.startswith("/"):
        raise ConfigError(f"{place}: tf2 takes no name with a slash in front; write {result.lstrip('/')!r}")
    if _beyond(leaf, result):
        raise refuse(value)
    return result


def _beyond(leaf: Leaf, value: Any) -> bool:
    if leaf.least is not None and 0 < value < leaf.least:
        return True
    return (leaf.low is not None and value < leaf.low) or (leaf.high is not None and value > leaf.high)


def _typed(kind: type, value: Any) -> Any:
    """``value`` as exactly ``kind`` (a whole number passes for a float), None where it is not one."""
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            return float(value) if math.isfinite(value) else None
        except OverflowError:  # a whole number beyond any float
            return None
    if isinstance(value, bool) is not (kind is bool) or not isinstance(value, kind):
        return None
    return None if isinstance(value, str) and "\0" in value else value


def _unknown(key: str, sections: bool = True) -> str:
    """``sections``: whether one of them may stand where ``key`` does, as at the start of a file's line."""
    section, _, last = key.rpartition(".")
    if section in _SECTIONS:  # that part is right: only the rest is to be like another
        own = {name.rpartition(".")[2]: name for name in _LEAVES if name.startswith(section + ".")}
        near = [own[name] for name in difflib.get_close_matches(last, own, 1, 0.6)]
    else:
        top = {name for name in _LEAVES if "." not in name} | (_SECTIONS if sections else set())
        near = difflib.get_close_matches(key, sorted(_LEAVES if section else top), 1, 0.6)
    near = near or [name for name in _LEAVES if name.rpartition(".")[2] == last]  # in the wrong section
    return f"{key}: unknown key" + (f"; did you mean {near[0]}?" if near else "; see docs/CONFIGURATION.md")


def _first(section: str) -> str:
    return next(key for key in _LEAVES if key.startswith(section + "."))


def _line(node: yaml.Node) -> int:
    return node.start_mark.line + 1


def _describe(found: Any) -> str:
    """What was found instead, short enough for one line."""
    if isinstance(found, yaml.MappingNode):
        return "a mapping"
    if isinstance(found, yaml.SequenceNode):
        return f"a list of {len(found.value)}"
    if isinstance(found, yaml.ScalarNode):
        tag = found.tag.removeprefix("tag:yaml.org,2002:")
        shown = found.value if len(found.value) <= 60 else found.value[:57] + "..."
        if found.style is not None or (tag == "str" and not _NUMBER.fullmatch(found.value)):
            return f"the text {shown!r}"
        return "nothing" if tag == "null" else f"{shown!r}"[1:-1]
    shown = repr(found)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _scalar_text(value: Any) -> str:
    """One value on one line, quoted where YAML needs it."""
    plain = list(value) if isinstance(value, tuple) else value
    # A control character that YAML reads as a line break must be escaped.
    readable = all(str(item).isprintable() for item in (value if isinstance(value, tuple) else (value,)))
    text: str = yaml.safe_dump([plain], default_flow_style=True, width=math.inf, allow_unicode=readable)
    return text.strip()[1:-1]
