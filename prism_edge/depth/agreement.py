"""Whether a loaded network has the input and the outputs that its card promises."""

from __future__ import annotations

from typing import Any

from prism_edge.depth.contract import ModelCard
from prism_edge.errors import ModelError


def roles(session: Any, card: ModelCard, file: str) -> tuple[str, dict[str, str]]:
    """Names of the input and of the outputs by role; ModelError where file and card disagree."""
    inputs = {item.name: item for item in session.get_inputs()}
    if card.views != 1:
        raise ModelError(f"{file}: takes {card.views} images at once; the daemon runs networks of one")
    if len(inputs) != 1:
        raise ModelError(f"{file}: takes {len(inputs)} inputs; a depth network takes one image")
    name = card.input_name or next(iter(inputs))
    if name not in inputs:
        raise ModelError(f"{file}: has no input {name!r} (its input is {next(iter(inputs))!r})")
    if inputs[name].type != "tensor(float)":
        raise ModelError(f"{file}: input {name!r} is {inputs[name].type}, but float32 is needed")
    expected = (1, 3, card.input_height, card.input_width)
    shape = inputs[name].shape
    free_or_equal = [not isinstance(n, int) or n == e for n, e in zip(shape, expected, strict=False)]
    if shape and (len(shape) != 4 or not all(free_or_equal)):  # one that isn't said may be any
        raise ModelError(f"{file}: input {name!r} has shape {shape}, but its card says {list(expected)}")
    outputs = {item.name: item for item in session.get_outputs()}
    inner = card.descriptor_layer if card.has_inner_descriptor else ""
    depth = depth_output(card, list(outputs), inner, file)
    by_role = {
        "depth": depth,
        "confidence": card.confidence_output,
        "descriptor": card.descriptor_output or card.descriptor_layer,
        "sky": card.sky_output,
        "rays": card.rays_output,
        "intrinsics": card.intrinsics_output,
    }
    by_role = {role: output for role, output in by_role.items() if output}
    for role, output in by_role.items():
        if output not in outputs:
            raise ModelError(f"{file}: has no output {output!r} for {role}, only {', '.join(outputs)}")
        if outputs[output].type not in ("tensor(float)", "tensor(float16)"):
            raise ModelError(f"{file}: output {output!r} is {outputs[output].type}, but float is needed")
    # Rays and intrinsics are asked for by whoever wants them, not with every keyframe.
    return name, {role: output for role, output in by_role.items() if role not in ("rays", "intrinsics")}


def depth_output(card: ModelCard, outputs: list[str], inner: str, file: str) -> str:
    """The output that is depth. ModelError where the card names none of several.

    ``inner``, the tensor that descriptors are pooled of, is an output by our own doing if others are there.
    """
    own = [output for output in outputs if output != inner] or outputs
    if not card.depth_output and len(own) != 1:
        raise ModelError(f"{file}: its card must name depth_output, one of {', '.join(outputs)}")
    return card.depth_output or own[0]
