"""What the tests of pulled networks share: entries of a server on loopback, and how to pull them."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from prism_edge.depth.pulling import pull
from prism_edge.depth.registry import Entry, find
from tests.depth.web_server import WebServer
from tests.synthetic.network import TinyNetwork


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def tiny_item(server: WebServer, file: str = "/tiny.onnx", **card: object) -> dict:
    """The registry's entry of a network of the server."""
    content = server.files[file]
    values = {k: v for k, v in vars(TinyNetwork().card()).items() if v not in (None, "")}
    values = {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
    return {
        "file": file[1:],
        "size": len(content),
        "url": server.url + file,
        "card": {"contract": 1, **values, "sha256": digest(content), **card},
    }


def split_item(server: WebServer) -> dict:
    data = server.files["/split.onnx.data"]
    item = tiny_item(server, "/split.onnx", name="split")
    listed = {"file": "split.onnx.data", "sha256": digest(data), "url": f"{server.url}/split.onnx.data"}
    return {**item, "data": [{**listed, "size": len(data)}]}


def checkpoint_item(server: WebServer, **more: object) -> dict:
    files = [{"file": name, "url": f"{server.url}/{name}"} for name in ("config.json", "model.safetensors")]
    words = {"licence": "CC-BY-NC-4.0", "depth_kind": "relative", "export": "a checkpoint"}
    return {"kind": "checkpoint", "name": "later", **words, "files": files, **more}


class Asked(list):
    """Records the licences that were put before the user."""

    def __call__(self, licence: str) -> None:
        self.append(licence)


def get(plan, asked=None, **more):
    return pull(plan, asked if asked is not None else Asked(), lambda name: lambda have, total: None, **more)


def entry(name: str) -> Entry:
    found = find(name)
    assert found is not None
    return found


def only_parts(folder: Path) -> bool:
    return not folder.exists() or all(name.endswith(".part") for name in os.listdir(folder))
