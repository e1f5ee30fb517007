"""What a depth network says of itself: one schema, read from ONNX metadata, a sidecar or the registry.

The schema is documented in docs/MODELS.md. In a YAML file the keys stand as they are; in an ONNX file's
``metadata_props`` each carries the prefix ``prism_edge.`` and its value is written as YAML.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from prism_edge.depth.inner_tensor import POOLINGS
from prism_edge.depth.onnx_file import CARD_PREFIX
from prism_edge.depth.prediction import OPEN, PROBABILITY
from prism_edge.errors import YAML_MISFITS, ModelError
from prism_edge.messages import MOST_BIAS

CONTRACT = 1  # version of the schema
METRIC, FOCAL_NORMALISED = "metric", "focal_normalised"
RELATIVE, INVERSE_RELATIVE = "relative", "inverse_relative"
KINDS = (METRIC, FOCAL_NORMALISED, RELATIVE, INVERSE_RELATIVE)
STRETCH, CROP = "stretch", "crop"
SPREAD, KEPT = "spread", "kept"
_LEAST_SPAN, _MOST_SPAN = 0.1, 600.0  # from black to white: 1 to 255 in all known networks
_LARGEST_FILE = 65_536  # bytes of a sidecar; a card takes one thousand
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class ModelCard:
    """The contract of one network file.

    The network's input is float32 (1, 3, input_height, input_width), in ``colours`` order, each value
    (pixel * pixel_scale - mean) / std. Raises ModelError from :func:`card_from_mapping`, never later.
    """

    name: str
    revision: str
    licence: str
    depth_kind: str  # metric | focal_normalised | relative | inverse_relative
    input_width: int
    input_height: int
    source: str = ""  # where it comes from, in words
    sha256: str = ""  # of the file; empty: not pinned
    layout: str = "NCHW"
    input_name: str = ""  # empty: the file's only input
    colours: str = "rgb"  # rgb | bgr
    pixel_scale: float = 1.0 / 255.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    resize: str = STRETCH  # stretch: the whole image; crop: its centre, with its aspect kept
    levels: str = SPREAD  # of a dark or pale picture: spread to half of the range, or kept as they are
    depth_output: str = ""  # empty: the file's only output
    depth_scale: float = 1.0  # what its depth is multiplied by to be metres: 0.001 of one in millimetres
    confidence_output: str = ""  # empty: the network gives none
    confidence_kind: str = ""  # probability | open; empty: told by its values
    descriptor_output: str = ""
    descriptor_layer: str = ""  # the tensor that it comes from; without an output, exposed when loaded
    descriptor_pooling: str = ""  # how that becomes one vector: token | mean | max | gem | grid
    sky_output: str = ""
    sky_limit: float = 0.3  # a sky value at or above this is no surface
    rays_output: str = ""  # (1, h, w, 6): direction and origin of each pixel's ray, in the camera's frame
    intrinsics_output: str = ""  # (1, 3, 3) camera matrix, pixels of the network's input
    views: int = 1  # images taken at once; the daemon runs networks of one
    canonical_focal_length: float | None = None  # pixels of the network's input
    scale_bias_sigma: float | None = None  # log-scale error that never averages out
    dsug_tau: float | None = None  # None: not fitted for this network
    dsug_temperature: float | None = None

    @property
    def has_metres(self) -> bool:
        """Whether its depth can be turned into metres without another network."""
        return self.depth_kind in (METRIC, FOCAL_NORMALISED)

    @property
    def has_inner_descriptor(self) -> bool:
        """Whether its descriptor is pooled from an inner tensor that the file does not put out."""
        return bool(self.descriptor_layer) and not self.descriptor_output

    @property
    def dsug(self) -> tuple[float, float]:
        """The uncertainty gate's tau and T as fitted for this network; (nan, nan) where they are not."""
        if self.dsug_tau is None or self.dsug_temperature is None:
            return math.nan, math.nan
        return self.dsug_tau, self.dsug_temperature

    def to_metadata(self) -> dict[str, str]:
        """The card as ONNX ``metadata_props``; :func:`card_from_metadata` reads it back."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        props = {CARD_PREFIX + "contract": str(CONTRACT)}
        for key, value in values.items():
            if value not in (None, ""):
                props[CARD_PREFIX + key] = str(list(value)) if isinstance(value, tuple) else str(value)
        return props


def card_from_mapping(values: Any, where: str) -> ModelCard:
    """The card in a mapping of the schema's keys; ``where`` names its origin in errors.

    Raises ModelError for an unknown or missing key, a wrong type or a value that can't be.
    """
    if not isinstance(values, Mapping):
        raise ModelError(f"{where}: a model card is a table of keys and values")
    rest = {str(key): value for key, value in values.items()}
    version = rest.pop("contract", None)
    if str(version) != str(CONTRACT):
        raise ModelError(f"{where}: contract is {version!r}; this version reads contract: {CONTRACT}")
    known = {field.name: field for field in fields(ModelCard)}
    for key in rest:
        if key not in known:
            raise ModelError(f"{where}: unknown key {key!r} (docs/MODELS.md lists them)")
    for name, field in known.items():
        if field.default is MISSING and name not in rest:
            raise ModelError(f"{where}: the key {name!r} is missing")
    checked = {}
    for key, value in rest.items():
        try:
            checked[key] = _CHECKS[key](value)
        except (ValueError, TypeError, OverflowError) as error:
            raise ModelError(f"{where}: {key}: {error}") from None
    card = ModelCard(**checked)
    _check_whole(card, where)
    return card


def card_from_metadata(props: Mapping[str, str], where: str) -> ModelCard | None:
    """The card in an ONNX file's metadata; None where the file does not describe itself."""
    mine = (key for key in props if key.startswith(CARD_PREFIX))
    own = {key.removeprefix(CARD_PREFIX): props[key] for key in mine}
    if not own:
        return None
    return card_from_mapping({key: _scalar(key, value, where) for key, value in own.items()}, where)


def card_from_sidecar(path: Path) -> ModelCard:
    """The card in a YAML file. Raises ModelError where it can't be read or breaks the schema."""
    return card_from_mapping(read_yaml(path), path.name)


class _Loader(yaml.SafeLoader):
    """YAML in which a card's text is as written, where YAML sees a number (1.10, 0276) or a date.

    What is given twice is refused: the last of two scales would count, and nobody would know.
    """

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen: set[object] = set()
        for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                problem = f"{key.value!r:.60} is given twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else key)
            is_said = isinstance(value, yaml.ScalarNode) and value.tag != "tag:yaml.org,2002:null"
            if is_said and _is_text(key.value):
                value.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep)


def read_yaml(path: Path, most: int = _LARGEST_FILE) -> Any:
    """The content of a small YAML file; ModelError in one line for whatever is wrong with it."""
    try:
        if path.stat().st_size > most:
            raise ModelError(f"{path}: larger than {most} bytes, which no model description needs")
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise ModelError(f"{path}: can't be read ({error.strerror})") from None
    except (yaml.YAMLError, *YAML_MISFITS) as error:
        line = getattr(getattr(error, "problem_mark", None), "line", None)
        place = f" line {line + 1}" if line is not None else ""
        problem = " ".join(str(getattr(error, "problem", None) or "").split())[:100]
        raise ModelError(f"{path}{place}: no valid YAML{problem and ': ' + problem}") from None


def _scalar(key: str, value: str, where: str) -> Any:
    if _is_text(key):
        return _unquoted(value)
    try:
        return yaml.safe_load(value[:4096])
    except (yaml.YAMLError, *YAML_MISFITS):
        raise ModelError(f"{where}: {key}: {value[:40]!r} can't be read") from None


def _unquoted(text: str) -> str:
    """Text as it is, or as a YAML writer has it: in quotes, or with a document's end after it."""
    plain = text.strip().removesuffix("\n...").strip()
    if plain[:1] not in ("'", '"'):
        return plain
    try:
        written = yaml.safe_load(plain[:4096])
    except (yaml.YAMLError, *YAML_MISFITS):
        return plain
    return written if isinstance(written, str) else plain


def _is_text(key: Any) -> bool:
    return isinstance(key, str) and _CHECKS.get(key) in (_text, _name, sha256_text)


def input_ranges(card: ModelCard) -> list[tuple[float, float]]:
    """What black and white are to the network, for each colour."""
    white, channels = 255.0 * card.pixel_scale, zip(card.mean, card.std, strict=True)
    return [((0.0 - mean) / std, (white - mean) / std) for mean, std in channels]


def _check_whole(card: ModelCard, where: str) -> None:
    if card.depth_scale != 1.0 and not card.has_metres:
        raise ModelError(f"{where}: depth_scale belongs to depth_kind {METRIC} and {FOCAL_NORMALISED} alone")
    if card.depth_kind == FOCAL_NORMALISED and card.canonical_focal_length is None:
        raise ModelError(f"{where}: depth_kind focal_normalised needs canonical_focal_length (pixels)")
    if card.depth_kind != FOCAL_NORMALISED and card.canonical_focal_length is not None:
        raise ModelError(f"{where}: canonical_focal_length belongs to depth_kind focal_normalised alone")
    if card.has_metres and card.scale_bias_sigma is None:
        raise ModelError(f"{where}: depth_kind {card.depth_kind} needs scale_bias_sigma (docs/MODELS.md)")
    for dark, bright in input_ranges(card):
        span = bright - dark
        if not (_LEAST_SPAN <= span <= _MOST_SPAN and dark <= span and bright >= -span):
            raise ModelError(
                f"{where}: pixel_scale, mean and std make {dark:.4g} of black and {bright:.4g} of white: "
                "mean and std of pixels from 0 to 255 need pixel_scale: 1, those of 0 to 1 the default, 1/255"
            )
    if (card.dsug_tau is None) != (card.dsug_temperature is None):
        raise ModelError(f"{where}: dsug_tau and dsug_temperature come together or not at all")
    if card.confidence_kind and not card.confidence_output:
        raise ModelError(f"{where}: confidence_kind needs a confidence_output")
    if card.sky_limit != ModelCard.sky_limit and not card.sky_output:
        raise ModelError(f"{where}: sky_limit needs a sky_output")
    if card.descriptor_pooling and not (card.descriptor_output or card.descriptor_layer):
        raise ModelError(f"{where}: descriptor_pooling needs a descriptor_output or a descriptor_layer")
    if card.has_inner_descriptor and not card.descriptor_pooling:
        raise ModelError(f"{where}: descriptor_layer without descriptor_output needs descriptor_pooling")


def _text(value: Any) -> str:
    if not isinstance(value, str | int | float) or isinstance(value, bool):
        raise ValueError(f"text is needed, not {value!r}")
    text = str(value).strip()
    if not text.isprintable() or len(text) > 500:
        raise ValueError("one line of at most 500 characters is needed")
    return text


def _name(value: Any) -> str:
    text = _text(value)
    if not _NAME.fullmatch(text):
        raise ValueError(f"{text!r} is no name (letters, digits, dot, dash, underscore; at most 64)")
    return text


def sha256_text(value: Any) -> str:
    """A SHA-256 in lower case, or nothing. Raises ValueError for any other value."""
    text = _text(value).lower()
    if text and not _SHA256.fullmatch(text):
        raise ValueError("64 hexadecimal digits are needed")
    return text


def _number(low: float, high: float) -> Callable[[Any], float]:
    def check(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError(f"a number is needed, not {value!r}")
        try:
            number = float(value)  # PyYAML reads 1e-8 as text
        except ValueError:
            raise ValueError(f"a number is needed, not {value!r}") from None
        if not math.isfinite(number) or not low <= number <= high:
            raise ValueError(f"{number:g} is not within {low:g} and {high:g}")
        return number

    return check


def _whole(low: int, high: int) -> Callable[[Any], int]:
    def check(value: Any) -> int:
        number = _number(low, high)(value)
        if number != int(number):
            raise ValueError(f"a whole number is needed, not {value!r}")
        return int(number)

    return check


def _triple(low: float, high: float) -> Callable[[Any], tuple[float, ...]]:
    def check(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise ValueError(f"three numbers are needed, not {value!r}")
        return tuple(_number(low, high)(item) for item in value)

    return check


def _choice(*words: str) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if value not in words:
            raise ValueError(f"{value!r} is none of {', '.join(words)}")
        return str(value)

    return check


_CHECKS: dict[str, Callable[[Any], Any]] = {
    "name": _name,
    "revision": _text,
    "licence": _text,
    "source": _text,
    "sha256": sha256_text,
    "depth_kind": _choice(*KINDS),
    "canonical_focal_length": _number(1.0, 1e5),
    "input_width": _whole(8, 4096),
    "input_height": _whole(8, 4096),
    "layout": _choice("NCHW"),
    "input_name": _text,
    "colours": _choice("rgb", "bgr"),
    "pixel_scale": _number(1e-6, 1e3),
    "mean": _triple(-1e3, 1e3),
    "std": _triple(1e-6, 1e3),
    "resize": _choice(STRETCH, CROP),
    "levels": _choice(SPREAD, KEPT),
    "depth_output": _text,
    "depth_scale": _number(1e-6, 1e6),
    "confidence_output": _text,
    "confidence_kind": _choice(PROBABILITY, OPEN),
    "descriptor_output": _text,
    "descriptor_layer": _text,
    "descriptor_pooling": _choice(*POOLINGS),
    "sky_output": _text,
    "sky_limit": _number(-1e6, 1e6),
    "rays_output": _text,
    "intrinsics_output": _text,
    "views": _whole(1, 64),
    "scale_bias_sigma": _number(1e-4, MOST_BIAS),
    "dsug_tau": _number(1e-6, 10.0),
    "dsug_temperature": _number(1e-6, 10.0),
}
