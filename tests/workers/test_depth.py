"""The depth worker on a bus of lists; what it sends is packed and unpacked as on the real one."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from prism_edge.bus.pack import pack
from prism_edge.config import Config, DepthConfig
from prism_edge.depth import DepthNetwork, open_network
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import FISHEYE
from prism_edge.messages import Acknowledged, EndOfStream, KeyframeImage
from prism_edge.workers import depth as worker
from prism_edge.workers.depth import DepthWorker, answer, main
from tests.synthetic.messages import tick
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_tiny_network
from tests.synthetic.sequence import synthetic_camera
from tests.synthetic.tint import tinted
from tests.workers.list_bus import ListBus

CAMERA = synthetic_camera()
DEPTH = np.tile(np.linspace(1.0, 4.0, CAMERA.width, dtype=np.float32), (CAMERA.height, 1))


def picture(keyframe: int, grey: bool = False) -> KeyframeImage:
    bgr = tinted(np.full(DEPTH.shape, 125, np.uint8), DEPTH)
    image, colour = pack(bgr[:, :, 1] if grey else bgr)
    return KeyframeImage(
        keyframe=keyframe,
        index=10 * keyframe,
        stamp_ns=keyframe * 333_000_000,
        epoch=2,
        colour=colour,
        camera_model=CAMERA.model,
        camera=CAMERA.to_array(),
        image=image,
    )


@pytest.fixture
def tiny(tmp_path: Path) -> str:
    return str(write_tiny_network(tmp_path / "tiny.onnx"))


def live(model: str) -> tuple[ListBus, Config]:
    return ListBus("keyframe_image"), Config(depth=DepthConfig(model=model))


def lockstep(model: str) -> tuple[ListBus, Config]:
    return ListBus("tracked"), Config(mode="lockstep", depth=DepthConfig(model=model))


def test_a_keyframes_picture_becomes_its_metric_depth(tiny: str):
    bus, config = live(tiny)
    bus.give("keyframe_image", picture(7))
    main(config, bus)
    (depth,) = bus.of("depth")
    assert (depth.keyframe, depth.stamp_ns, depth.epoch) == (7, 7 * 333_000_000, 2)
    assert (depth.valid, depth.reason, depth.model.split("@")[0]) == (True, "", "tiny_tint")
    assert depth.bias_sigma == pytest.approx(0.05)
    a, b, c, d = depth.image_to_depth
    assert depth.depth[round(c * 240 + d), round(a * 320 + b)] == pytest.approx(DEPTH[240, 320], rel=0.03)
    assert depth.confidence.shape == (0, 0)
    assert bus.states == ["loading the network", "ready", "keyframe 7", "idle"]
    values = bus.pulse.values
    assert (values["model"], values["provider"]) == ("tiny_tint", "CPUExecutionProvider")
    assert values["keyframes"] == "1"
    assert float(values["inference_ms"]) > 0
    assert float(values["inference_ms_median"]) > 0


@pytest.mark.parametrize(("turns", "turned"), [(0, ""), (3, "+270"), (2, "+180"), (6, "+180"), (-1, "+270")])
def test_a_network_sees_upright_what_a_camera_that_is_not_has_taken(
    tiny: str, turns: int, turned: str, caplog
):
    """The picture says how it is turned: on another computer nobody knows how the camera sits."""
    caplog.set_level(logging.INFO)
    bus, config = live(tiny)
    bus.give("keyframe_image", replace(picture(7), turns=turns))
    main(config, bus)
    (depth,) = bus.of("depth")
    assert re.fullmatch(rf"tiny_tint@[0-9a-f]{{12}}{re.escape(turned)}", depth.model)
    assert (f"turned by {turned[1:]} degrees" in caplog.text) if turned else ("turned" not in caplog.text)
    a, b, c, d = depth.image_to_depth
    for x, y in ((320, 240), (100, 60), (600, 400)):
        assert depth.depth[round(c * y + d), round(a * x + b)] == pytest.approx(DEPTH[y, x], rel=0.05)
    assert bus.pulse.values["model"] == "tiny_tint"


@pytest.mark.parametrize("turns", [0, 1])
def test_a_network_sees_straight_what_a_strongly_bent_lens_has_taken(tiny: str, turns: int, caplog):
    caplog.set_level(logging.INFO)
    bus, config = live(tiny)
    fisheye = replace(CAMERA, model=FISHEYE, fx=0.5 * CAMERA.fx, fy=0.5 * CAMERA.fy)
    one, two = (
        replace(picture(k), turns=turns, camera_model=FISHEYE, camera=fisheye.to_array()) for k in (7, 8)
    )
    bus.give("keyframe_image", one, two)
    main(config, bus)
    for depth in bus.of("depth"):
        assert depth.model.endswith("+90+straight" if turns else "+straight")
        a, b, c, d = depth.image_to_depth
        for x, y in ((320, 240), (200, 160), (420, 300)):
            assert depth.depth[round(c * y + d), round(a * x + b)] == pytest.approx(DEPTH[y, x], rel=0.05)
        assert depth.depth[round(c * 2 + d), round(a * 2 + b)] == 0.0
    assert caplog.text.count("pictures are set straight") == 1


@pytest.mark.parametrize(("loading_s", "budget_s"), [(0.5, 20.0), (30.0, 60.0), (500.0, 120.0)])
def test_what_took_long_to_load_may_take_long_to_answer(
    tiny: str, loading_s: float, budget_s: float, monkeypatch: pytest.MonkeyPatch
):
    """Loading ends with an inference; one that takes longer than most is no hang at each keyframe."""
    now_s = [0.0]

    def slowly(config: Config) -> DepthNetwork:
        now_s[0] += loading_s
        return open_network(tiny, config.depth)

    monkeypatch.setattr(worker, "open_depth", slowly)
    monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    bus, config = live(tiny)
    bus.give("keyframe_image", picture(7))
    main(config, bus)
    assert bus.budgets_s["keyframe 7"] == pytest.approx(budget_s)


def test_what_a_lost_camera_shows_in_between_hides_no_keyframe_that_was_passed_over(tiny: str):
    bus, config = live(tiny)
    bus.give("keyframe_image", *(picture(number) for number in (3, -5, 6, -9, 7)))
    main(config, bus)
    assert bus.pulse.values["dropped"] == "2"


def test_the_newest_keyframe_wins_and_those_passed_over_are_counted(tiny: str):
    bus, config = live(tiny)
    numbers = [0, 1, 5, 10_000_000_000, 10_000_000_001]
    bus.give("keyframe_image", *(picture(number) for number in numbers))
    main(config, bus)  # a tracker that started again numbers from far above
    assert bus.inboxes["keyframe_image"].newest
    assert [depth.keyframe for depth in bus.of("depth")] == numbers
    assert bus.pulse.values["dropped"] == "3"


def test_a_picture_that_is_shown_again_gets_the_answer_that_it_got(tiny: str):
    """The network does not work for it once more: a slow one was at it when the tracker asked again."""
    bus, config = live(tiny)
    later = replace(picture(4), stamp_ns=picture(4).stamp_ns + 1)
    bus.give("keyframe_image", picture(3), picture(3), replace(picture(3), epoch=3), picture(4), later)
    main(config, bus)
    first, again, elsewhere, fourth, of_another_run = bus.of("depth")
    assert of_another_run.stamp_ns == fourth.stamp_ns + 1
    assert (again.keyframe, again.epoch, again.inference_ms) == (3, 2, first.inference_ms)
    assert np.array_equal(again.depth, first.depth)
    assert elsewhere.epoch == 3
    assert bus.pulse.values["keyframes"] == "4"


def test_a_grey_picture_is_answered_too(tiny: str):
    bus, config = live(tiny)
    bus.give("keyframe_image", picture(0, grey=True))
    main(config, bus)
    (depth,) = bus.of("depth")
    assert not depth.valid  # the tint is gone: the tiny network sees one depth everywhere
    assert "constant" in depth.reason


@pytest.mark.parametrize("misbehaviour", ["nan", "zero", "negative", "constant"])
def test_a_misbehaving_network_is_reported_and_counted(tmp_path: Path, misbehaviour: str):
    path = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(misbehaviour=misbehaviour))
    bus, config = live(str(path))
    bus.give("keyframe_image", picture(0), picture(1))
    main(config, bus)
    assert [depth.valid for depth in bus.of("depth")] == [False, False]
    assert not any(depth.depth.any() for depth in bus.of("depth"))
    assert all(depth.reason for depth in bus.of("depth"))
    assert bus.pulse.values["invalid"] == "2"


@pytest.mark.parametrize(
    "change",
    [
        {"image": np.zeros((10, 10), np.uint8)},
        {"image": np.zeros((0, 0), np.uint8)},
        {"camera": np.array([640.0, 480.0, -1.0, 525.0, 320.0, 240.0])},
        {"camera": np.array([640.0])},
        {"camera_model": "mirror"},
    ],
)
def test_an_inference_that_fails_is_an_invalid_answer(tiny: str, change: dict):
    bus, config = live(tiny)
    bus.give("keyframe_image", replace(picture(0), **change), picture(1))
    main(config, bus)
    failed, fine = bus.of("depth")
    assert (failed.valid, fine.valid) == (False, True)
    assert failed.reason.startswith("inference failed: ")
    assert "\n" not in failed.reason
    assert bus.pulse.values["invalid"] == "1"


@pytest.mark.parametrize("provider", ["CUDAExecutionProvider", "CPUExecutionProvider"])
@pytest.mark.parametrize("mode", [live, lockstep])
def test_only_a_gpu_that_is_gone_ends_the_worker_and_only_in_real_time(tiny, mode, provider, monkeypatch):
    """The supervisor starts it again: another process may have the GPU, or falls back to the CPU."""
    network = open_network(tiny, DepthConfig())
    clock = iter(range(0, 10_000, 7))
    monkeypatch.setattr(network, "provider", provider)
    monkeypatch.setattr(network, "infer", lambda *picture: 1 / 0)
    monkeypatch.setattr(worker, "open_depth", lambda config: network)
    monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic=lambda: float(next(clock))))
    bus, config = mode(tiny)
    depth_worker = DepthWorker(config, bus)
    for keyframe in range(1, 5):
        if keyframe == 4 and mode is live and provider.startswith("CUDA"):
            with pytest.raises(ModelError, match="failed at 4 images in 21 s: starting anew"):
                depth_worker._answer(picture(keyframe))
        else:
            depth_worker._answer(picture(keyframe))
    assert not any(depth.valid for depth in bus.of("depth"))


def test_what_onnxruntime_says_is_told_without_where_in_its_source(tiny: str, monkeypatch):
    network = open_network(tiny, DepthConfig())
    lost = "[ONNXRuntimeError] : 1 : FAIL : CUDA failure 999: unknown error ; GPU=0 ; hostname=vm ; file=/a"
    monkeypatch.setattr(network, "infer", Mock(side_effect=RuntimeError(lost)))
    assert answer(network, picture(0)).reason == "inference failed: CUDA failure 999: unknown error"


def test_metres_that_can_not_be_are_on_health_and_once_on_the_log(tmp_path: Path, caplog):
    bus, config = live(str(write_tiny_network(tmp_path / "mm.onnx", TinyNetwork(gain=1000.0))))
    bus.give("keyframe_image", picture(1), picture(2), picture(3))
    main(config, bus)
    assert all(depth.valid for depth in bus.of("depth"))
    assert "a median depth of" in bus.pulse.values["warning"]
    assert caplog.text.count("depth_scale in its card") == 1


def test_a_pair_that_never_fits_is_on_health_and_once_on_the_log_with_what_would_fit(tmp_path: Path, caplog):
    """Disparity that is called depth: the commonest mistake in a card."""
    mistaken, card = TinyNetwork(name="r", depth_kind="inverse_relative"), TinyNetwork(depth_kind="relative")
    save(tmp_path / "r.onnx", tiny_graph(mistaken), replace(card.card(), name="r"))
    metric = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="m"))
    bus, config = live(f"nested:{tmp_path / 'r.onnx'},{metric}")
    bus.give("keyframe_image", *(picture(i) for i in range(8)))
    main(config, bus)
    said = "r fits m in 0 of 8 images: m stands alone; with depth_kind: inverse_relative in its card it would"
    assert said in bus.pulse.values["warning"]
    assert caplog.text.count("r fits m in 0 of 5 images") == caplog.text.count("fits m in") == 1


def test_a_doubt_of_another_kind_is_on_the_log_too(tmp_path: Path, caplog):
    metric = write_tiny_network(tmp_path / "mm.onnx", TinyNetwork(gain=1000.0))
    bus, config = live(str(metric))
    made = DepthWorker(config, bus)
    made._answer(picture(1))
    near = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="near"))
    made._network.infer = open_network(str(near), DepthConfig()).infer
    made._network.doubt = "r fits m in 0 of 5 images"
    made._answer(picture(2))
    made._answer(picture(3))
    assert caplog.text.count("keyframe 1: a median depth of") == 1
    assert caplog.text.count("keyframe 2: r fits m") == caplog.text.count("r fits m") == 1


def test_metres_that_can_be_are_no_warning(tiny: str):
    bus, config = live(tiny)
    bus.give("keyframe_image", picture(1))
    main(config, bus)
    assert "warning" not in bus.pulse.values


def test_lockstep_acknowledges_each_frame_after_its_depth(tiny: str):
    bus, config = lockstep(tiny)
    bus.give("keyframe_image", picture(0), picture(1))  # the second is early
    bus.give("tracked", tick(0, keyframe=0), tick(1), tick(2), tick(10, keyframe=1), tick(11))
    bus.give("end", EndOfStream(12, 12, 0, 0, 11))
    main(config, bus)
    assert not bus.inboxes["keyframe_image"].newest
    order = [message.index if isinstance(message, Acknowledged) else "depth" for _, message in bus.sent]
    assert order == ["depth", 0, 1, 2, "depth", 10, 11]
    assert [depth.keyframe for depth in bus.of("depth")] == [0, 1]
    assert all(m.process == "depth" for t, m in bus.sent if t == "acknowledged")
    assert bus.states[-1] == "ended"


def test_lockstep_does_without_a_picture_that_never_comes(tiny: str):
    bus, config = lockstep(tiny)
    bus.give("keyframe_image", picture(4))
    bus.give("tracked", tick(0, keyframe=3), tick(1, keyframe=4))
    DepthWorker(config, bus, patience_s=0.05).run()
    assert [depth.keyframe for depth in bus.of("depth")] == [4]
    assert [m.index for t, m in bus.sent if t == "acknowledged"] == [0, 1]
    assert bus.pulse.values["dropped"] == "1"


def test_a_network_that_answers_again_is_warned_of_no_more(tiny: str, monkeypatch):
    network = open_network(tiny, DepthConfig())
    good = network.infer
    monkeypatch.setattr(worker, "open_depth", lambda config: network)
    bus, config = live(tiny)
    depth_worker = DepthWorker(config, bus)
    monkeypatch.setattr(network, "infer", lambda *picture: 1 / 0)
    depth_worker._answer(picture(1))
    assert "no usable depth" in bus.pulse.values["warning"]
    monkeypatch.setattr(network, "infer", good)
    depth_worker._answer(picture(2))
    assert [depth.valid for depth in bus.of("depth")] == [False, True]
    assert "warning" not in bus.pulse.values


def test_an_answer_says_of_its_picture_and_its_network_what_they_are(tiny: str):
    """All but the metres is believed on its word: by the gate, the scale and the backend."""
    network = open_network(tiny, DepthConfig())
    sure = replace(network.infer(np.zeros((480, 640, 3), np.uint8), CAMERA), confidence=np.full((2, 3), 0.5))
    said = Mock(identity="one@2", bias_sigma=0.07, dsug=(0.3, 0.8), frame_sigma=0.02)
    said.infer.return_value = sure
    depth = answer(said, picture(3))
    assert (depth.model, depth.bias_sigma, depth.frame_sigma) == ("one@2", 0.07, 0.02)
    assert (depth.dsug_tau, depth.dsug_temperature) == (0.3, 0.8)
    assert depth.confidence is sure.confidence
    said.infer.side_effect = RuntimeError
    for failed in (answer(said, picture(3)), answer(None, picture(3))):
        assert not failed.valid
        assert (failed.keyframe, failed.stamp_ns, failed.epoch) == (3, depth.stamp_ns, 2)


def test_two_lockstep_runs_are_identical(tiny: str):
    runs = []
    for _ in range(2):
        bus, config = lockstep(tiny)
        bus.give("keyframe_image", picture(0))
        bus.give("tracked", tick(0, keyframe=0))
        main(config, bus)
        runs.append(bus.of("depth")[0].depth)
    assert np.array_equal(*runs)


@pytest.mark.parametrize("model", ["", "none"])
@pytest.mark.parametrize("mode", [live, lockstep])
def test_without_a_network_nobody_waits_for_depth(mode, model):
    bus, config = mode(model)
    bus.give("keyframe_image", picture(0))
    bus.give("tracked", tick(0, keyframe=0))
    main(config, bus)
    (depth,) = bus.of("depth")
    assert not depth.valid
    assert depth.reason == "no depth network is configured"
    assert depth.model == "none"


def test_a_network_that_can_not_be_run_ends_the_worker_before_it_is_ready():
    bus, config = live("no/such.onnx")
    with pytest.raises(ModelError, match="no such file"):
        main(config, bus)
    assert bus.states == ["loading the network"]


def test_pairing_that_fails_shows_on_health(tmp_path: Path):
    bad = TinyNetwork(name="r", depth_kind="relative", misbehaviour="nan")
    relative = write_tiny_network(tmp_path / "r.onnx", bad)
    metric = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="m"))
    bus, config = live(f"nested:{relative},{metric}")
    bus.give("keyframe_image", picture(0))
    main(config, bus)
    assert bus.of("depth")[0].valid
    assert bus.pulse.values["unpaired"] == "1"
    assert bus.pulse.values["model"] == "nested:r,m"


@pytest.mark.parametrize("lost", ["CUDAExecutionProvider", "CPUExecutionProvider"])
def test_a_pair_whose_relative_network_lost_its_gpu_is_started_anew_too(tmp_path: Path, monkeypatch, lost):
    relative = write_tiny_network(tmp_path / "r.onnx", TinyNetwork(name="r", depth_kind="relative"))
    metric = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="m"))
    network = open_network(f"nested:{relative},{metric}", DepthConfig())
    monkeypatch.setattr(network._relative, "provider", lost)
    monkeypatch.setattr(network._relative, "raw", lambda picture: 1 / 0)
    noted, failing = [], Mock(note=lambda error, now_s: noted.append(type(error)))
    assert answer(network, picture(0), failing).valid, "the metric one's depth, meanwhile"
    assert noted == [ZeroDivisionError if lost.startswith("CUDA") else type(None)]
    turned = replace(picture(0), turns=1)
    assert answer(network, turned, failing).valid
    assert noted[1:] == noted[:1], "upright or not"


@pytest.mark.realdata
def test_a_real_network_answers(fastdepth: Path):
    depth = answer(open_network(str(fastdepth), DepthConfig()), picture(0))
    assert depth.valid
    assert depth.depth.shape == (224, 224)
    assert depth.bias_sigma == pytest.approx(0.10)
