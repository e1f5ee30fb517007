"""Run by the export tool's own Python, which tests can't import: python da3_process.py ACTION ARGUMENT...

What is compared with the tool's files here comes from the package `depth-anything-3` alone.
"""

from __future__ import annotations

import contextlib
import io
import json
import resource
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.export_da3 import __main__ as tool  # first, for the package's logging to be set
from tools.export_da3 import cameras, checkpoints, convert, nested, parity, pictures

SEED = 5


def checkpoint(folder: str) -> None:
    """Writes seeded weights of da3-small as the package's users have them: a folder, and a bare .pth."""
    from safetensors.torch import save_model

    net = checkpoints.random("da3-small", SEED)[0].net
    holder = torch.nn.Module()
    holder.model = net  # the prefix of published files
    out = Path(folder)
    (out / "published").mkdir()
    # Weights that layers share are saved under one of their names.
    save_model(holder, str(out / "published" / "model.safetensors"))
    (out / "published" / "config.json").write_text(json.dumps({"model_name": "da3-small"}))
    torch.save(net.state_dict(), out / "bare.pth")
    torch.save({"head.norm.weight": torch.zeros(3)}, out / "other.pth")
    (out / "text.safetensors").write_text("no weights")
    for name in ("da3mono-large", "DA3NESTED-GIANT-LARGE-1.1"):  # to be refused before they are read
        (out / name).mkdir()
        (out / name / "model.safetensors").write_text("no weights")


def reference(weights: str, height: str, width: str, image: str, out: str) -> None:
    """The package's whole forward pass on one image file, prepared as the daemon does."""
    from depth_anything_3.cfg import create_object, load_config
    from depth_anything_3.registry import MODEL_REGISTRY

    net = create_object(load_config(MODEL_REGISTRY["da3-small"])).eval()
    net.load_state_dict(torch.load(weights, weights_only=True))
    (picture,) = pictures.pictures([Path(image)], 1)
    with torch.no_grad():
        answer = net(pictures.tensor(picture, int(height), int(width))[None])
    names = {"depth": "depth", "depth_conf": "confidence", "intrinsics": "intrinsics"}
    np.savez(out, **{ours: answer[theirs][0].numpy() for theirs, ours in names.items()})


def geometry() -> None:
    """Prints largest errors of what the tool writes anew, against the package's functions and numpy."""
    from depth_anything_3.model.utils.transform import extri_intri_to_pose_encoding, mat_to_quat
    from depth_anything_3.utils.alignment import compute_alignment_mask, least_squares_scale_scalar
    from depth_anything_3.utils.geometry import affine_inverse

    rng = np.random.default_rng(1)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(200)]
    turns = [turn * np.sign(np.linalg.det(turn)) for turn in turns]
    turns += [np.diag(d) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]  # half turns: w is 0
    rotation = torch.tensor(np.array(turns), dtype=torch.float32)
    ours, theirs = cameras.quaternion(rotation), mat_to_quat(rotation)
    pose = torch.eye(4).repeat(len(turns), 1, 1)
    pose[:, :3, :3], pose[:, :3, 3] = rotation, torch.tensor(rng.normal(size=(len(turns), 3)))
    matrix = torch.tensor([[100.0, 0, 60], [0, 90, 50], [0, 0, 1]]).repeat(len(turns), 1, 1)
    ours_encoded = cameras.pose_encoding(pose, matrix, 98, 126)
    encoded = extri_intri_to_pose_encoding(affine_inverse(pose)[None], matrix[None], (98, 126))[0]

    shape = (1, 40, 50)
    d, m, c, s = (torch.tensor(rng.uniform(0.5, 2, shape), dtype=torch.float32) for _ in range(4))
    s = s - 0.9  # a part of it is sky
    ground = s < 0.3
    mask = compute_alignment_mask(c, ground, d, m, torch.quantile(c[ground], 0.5))
    factor = least_squares_scale_scalar(m[mask], d[mask])
    medians = []
    for count in (1, 2, 7, 8, 2000):
        chosen = torch.zeros(shape, dtype=torch.bool).reshape(-1)
        chosen[torch.tensor(rng.permutation(2000)[:count])] = True
        median = nested.masked_median(c, chosen.reshape(shape))
        medians.append(abs(float(median) - float(np.median(c.reshape(-1)[chosen].numpy()))))
    print(
        json.dumps(
            {
                "quaternion": float((ours - theirs).abs().max(dim=-1).values.median()),
                "quaternion_up_to_sign": float((1 - (ours * theirs).sum(dim=-1).abs()).abs().max()),
                "pose_encoding": float((ours_encoded - encoded)[:200].abs().max()),
                "nested": float((nested.nested_depth(d, c, m, s) - factor * d).abs().max()),
                "nested_all_sky": float(nested.nested_depth(d, c, m, s + 10).abs().max()),
                "median": max(medians),
            }
        )
    )


def large(out: str, image: str) -> None:
    """Exports in every precision as if 20 MB were more than a file can hold."""
    convert._LARGEST_MESSAGE = 20_000_000
    size = ["--height", "42", "--width", "56", "--images", image, image, image]
    code = tool.main(
        [out, "--random-weights", "2", "--model", "da3-small", "--precision", "fp32", "fp16", "int8", *size]
    )
    print(json.dumps(code))


def refusals(folder: str) -> None:
    """Prints what each wrong call says, and whether a file was left."""
    files = Path(folder)
    out = str(files / "refused.onnx")
    small = ["--random-weights", "1", "--model", "da3-small", "--height", "42", "--width", "56"]
    published, unread = str(files / "published"), str(files / "text.safetensors")
    calls = {
        "size": ([out, "--random-weights", "1", "--model", "da3-small", "--height", "100"], {}),
        "no checkpoint": ([out], {}),
        "no model": ([str(files / "bare.pth"), out], {}),
        "no such file": ([str(files / "absent"), out, "--model", "da3-small"], {}),
        "wrong weights": ([str(files / "other.pth"), out, "--model", "da3-small"], {}),
        "wrong model": ([str(files / "bare.pth"), out, "--model", "da3-base"], {}),
        "another": ([published, out, "--model", "da3-base"], {}),
        "no metric": ([published, out, "--metric", str(files / "da3mono-large")], {}),
        "nested already": ([str(files / "DA3NESTED-GIANT-LARGE-1.1"), out, "--metric", published], {}),
        "name": ([unread, out, "--model", "da3-small", "--name", "two words"], {}),
        "sigma": ([unread, out, "--model", "da3metric-large", "--scale-bias-sigma", "nan"], {}),
        "no weights": ([str(files / "text.safetensors"), out, "--model", "da3-small"], {}),
        "extension": ([*small, str(files / "refused.bin")], {}),
        "views": ([*small, out, "--views", "65"], {}),
        "no descriptor": ([*small, out, "--views", "5", "--descriptor", "token"], {}),
        "no intrinsics": ([*small, out, "--views", "5", "--intrinsics"], {}),
        "another's name": ([*small, out, "--name", "prism_nano"], {}),
        "two weights": ([unread, *small, out], {}),
        "no metres": ([*small, out, "--scale-bias-sigma", "0.3"], {}),
        "images first": ([unread, out, "--model", "da3-small", "--images", str(files / "absent")], {}),
        "images": ([*small, out, "--images", str(files / "published")], {}),
        "no folder to write to": ([*small, "/proc/refused.onnx"], {}),
        "full disk": ([*small, out], {"largest": 10_000_000}),
        "parity": ([*small, out, "--external-data"], {"bound": 1e-12}),
    }
    said = {}
    most = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    for what, (arguments, changes) in calls.items():
        parity.BOUNDS[convert.FP32] = changes.get("bound", 1e-4)
        resource.setrlimit(resource.RLIMIT_FSIZE, (changes.get("largest", most), most))
        error = io.StringIO()
        with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
            code = tool.main(arguments)
        said[what] = [code, error.getvalue().strip(), len(list(files.glob("refused*")))]
    print(json.dumps(said))


if __name__ == "__main__":
    torch.set_num_threads(1)
    known = (checkpoint, reference, geometry, large, refusals)
    actions = {action.__name__: action for action in known}
    actions[sys.argv[1]](*sys.argv[2:])
