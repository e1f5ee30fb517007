"""A relative network in a metric one's metres: the fit against known truth, and when it is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from prism_edge.depth import pairing
from prism_edge.depth.pairing import Fit, PairedNetwork, fit_depth, fit_inverse_depth, metres
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_tiny_network
from tests.synthetic.sequence import synthetic_camera
from tests.synthetic.tint import tinted

DEPTHS = np.random.default_rng(0).uniform(0.8, 6.0, 2000)


@settings(max_examples=50, deadline=None)
@given(
    slope=st.floats(1e-3, 1e3),
    shift=st.floats(-0.1, 2.0),
    unit=st.floats(1e-3, 1e3),
)
def test_an_exact_relation_is_found_whatever_the_unit(slope, shift, unit):
    relative = (1 / DEPTHS - shift) / slope * unit
    fit = fit_inverse_depth(relative, DEPTHS)
    assert fit is not None
    assert metres(relative.astype(np.float64)[None], fit, 1e3)[0] == pytest.approx(DEPTHS, rel=1e-4)


def test_outliers_do_not_move_the_fit():
    rng = np.random.default_rng(1)
    relative = (1 / DEPTHS - 0.05) / 0.01
    metric = DEPTHS * np.exp(rng.normal(0, 0.05, DEPTHS.size))
    spoilt = rng.random(DEPTHS.size) < 0.3
    metric[spoilt] = rng.uniform(4.0, 8.0, spoilt.sum())
    fit = fit_inverse_depth(relative, metric)
    assert fit is not None
    assert fit.slope == pytest.approx(0.01, rel=0.06)
    # least squares is off by far more: the test would notice a fit that is not robust
    plain = np.polyfit(relative, 1 / metric, 1)
    assert abs(plain[0] / 0.01 - 1) > 0.15


@pytest.mark.parametrize(
    ("relative", "metric"),
    [
        (-1 / DEPTHS, DEPTHS),  # runs the wrong way
        (np.ones_like(DEPTHS), DEPTHS),  # constant
        (np.full_like(DEPTHS, np.nan), DEPTHS),
        (1 / DEPTHS, np.zeros_like(DEPTHS)),  # no metric depth at all
        (1 / DEPTHS[:50], DEPTHS[:50]),  # too few
        (1 / DEPTHS, np.random.default_rng(2).permutation(10.0 ** (DEPTHS - 3))),  # unrelated
    ],
)
def test_networks_that_do_not_fit_are_not_joined(relative, metric):
    assert fit_inverse_depth(relative, metric) is None


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(width=32), min_size=100, max_size=120), st.integers(0, 2**32 - 1))
def test_any_values_give_a_finite_fit_or_none(values, seed):
    relative = np.array(values)
    fit = fit_inverse_depth(relative, np.random.default_rng(seed).uniform(0.5, 5.0, len(values)))
    assert fit is None or np.isfinite([fit.slope, fit.shift, fit.spread]).all()


@pytest.mark.parametrize("shift", [3.0, 1.6, 0.8, 0.4, 0.0, -2.0])
def test_depth_up_to_scale_and_shift_is_found_as_such(shift: float):
    rng = np.random.default_rng(3)
    relative = (DEPTHS - shift) / 7
    metric = DEPTHS * np.exp(rng.normal(0, 0.1, DEPTHS.size))
    spoilt = rng.random(DEPTHS.size) < 0.2
    metric[spoilt] = rng.uniform(4.0, 8.0, spoilt.sum())
    fit = fit_depth(relative, metric)
    assert fit is not None
    values = relative if fit.of_depth else 1 / relative
    out = metres(values[None], fit, farthest=1e3)[0]
    assert np.median(np.abs(out / DEPTHS - 1)) < 0.03
    assert np.percentile(np.abs(out / DEPTHS - 1), 95) < 0.15


def test_depth_up_to_scale_alone_is_exact_too():
    fit = fit_depth(DEPTHS / 7, DEPTHS)
    assert fit is not None
    out = metres(np.array([[0.5 / 7, -1.0, np.nan]]), Fit(7.0, 0.0, 0.0, of_depth=True), farthest=9.0)
    assert out[0] == pytest.approx([0.5, 0, 0])
    assert fit.spread < 1e-6


def test_relative_depth_that_is_nothing_counts_for_nothing():
    relative = np.where(np.arange(DEPTHS.size) % 3 == 0, 0.0, (DEPTHS - 3.0) / 7)
    relative[1:600:3] = np.nan
    relative[601:900:3] = np.inf  # sky
    fit = fit_depth(relative, DEPTHS)
    assert fit is not None
    assert (fit.of_depth, fit.slope, fit.shift) == (True, pytest.approx(7.0), pytest.approx(3.0))


def test_infinite_relative_depth_counts_for_nothing_in_inverse_depth_either():
    """1 / inf is 0, which would be a sample like any other."""
    relative = 1.0 / (0.5 / DEPTHS + 0.1)
    sky = np.where(np.arange(DEPTHS.size) % 3 == 0, np.inf, relative)
    fit = fit_depth(sky, DEPTHS)
    assert fit is not None
    assert fit == fit_depth(np.where(np.isinf(sky), np.nan, sky), DEPTHS)
    assert not fit.of_depth


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3]), st.sampled_from([-1.0, 1.0]))
def test_of_positive_depths_both_fits_are_tried_on_all_of_them(seed, nothing, power):
    rng = np.random.default_rng(seed)
    relative = (DEPTHS * np.exp(rng.normal(0, 0.2, DEPTHS.size)) + rng.uniform(0, 3)) ** power
    relative[rng.random(DEPTHS.size) < nothing] = 0.0
    relative[rng.random(DEPTHS.size) < nothing] = np.nan
    d, z = relative[relative > 0], DEPTHS[relative > 0]
    fits = (fit_inverse_depth(1.0 / d, z), pairing._fit(d, z, of_depth=True))
    assert fit_depth(relative, DEPTHS) == min((f for f in fits if f), key=lambda f: f.spread, default=None)


@pytest.mark.parametrize("shift", [-0.45, -2.5])
def test_a_shift_of_relative_depth_is_found_in_a_pair(tmp_path: Path, shift: float):
    what = TinyNetwork(name="shifted", depth_kind="relative", width=640, height=480)
    graph = tiny_graph(what)
    graph.output[0].name = "moved"
    value = helper.make_tensor("shift", TensorProto.FLOAT, [1], [shift])  # of 0.5 to 4 m
    graph.node.append(helper.make_node("Constant", [], ["shift"], value=value))
    graph.node.append(helper.make_node("Add", ["depth", "shift"], ["moved"]))
    save(tmp_path / "shifted.onnx", graph, replace(what.card(), depth_output="moved"))
    paired = PairedNetwork(OnnxNetwork(tmp_path / "shifted.onnx"), network(tmp_path, "m"))
    image, depth = view()
    answer = paired.infer(image, CAMERA)
    truth = cv2.resize(depth, (160, 120), interpolation=cv2.INTER_AREA)
    assert paired.counters == {"unpaired": 0}
    assert (answer.depth > 0).all()
    assert np.percentile(np.abs(np.log(answer.depth / truth)), 95) < 0.03


def test_nothing_lies_beyond_the_farthest():
    fit = fit_inverse_depth(1 / DEPTHS, DEPTHS)
    assert fit is not None
    out = metres(np.array([[1.0, 0.2, 0.05, 0.0, -1.0, np.nan]], np.float32), fit, farthest=10.0)
    assert out[0] == pytest.approx([1.0, 5.0, 0, 0, 0, 0], rel=1e-3)


CAMERA = synthetic_camera()


def view() -> tuple[np.ndarray, np.ndarray]:
    """RGB image of two walls, and the depth they are at."""
    depth = np.tile(np.linspace(1.0, 4.0, CAMERA.width, dtype=np.float32), (CAMERA.height, 1))
    depth[300:] *= 0.5
    return np.ascontiguousarray(tinted(np.full(depth.shape, 120, np.uint8), depth)[:, :, ::-1]), depth


def network(folder: Path, name: str, **options: object) -> OnnxNetwork:
    return OnnxNetwork(write_tiny_network(folder / f"{name}.onnx", TinyNetwork(name=name, **options)))


@pytest.mark.parametrize("unit", [1.0, 1e-7])
def test_relative_depth_may_be_of_any_unit(tmp_path: Path, monkeypatch, unit: float):
    """Of a depth that only 1 / z = a / d + b fits."""
    relative, metric = network(tmp_path, "r", depth_kind="relative"), network(tmp_path, "m")
    alone = metric.infer(view()[0], CAMERA)
    moved = (unit / (1.0 / alone.depth + 0.3)).astype(np.float32)
    monkeypatch.setattr(relative, "raw", lambda rgb: (replace(alone, depth=moved), None))
    paired = PairedNetwork(relative, metric)
    answer = paired.infer(view()[0], CAMERA)
    assert paired.counters == {"unpaired": 0}
    np.testing.assert_allclose(answer.depth, alone.depth, rtol=1e-3)


@pytest.mark.parametrize("kind", ["relative", "inverse_relative"])
def test_relative_detail_comes_in_the_metric_networks_metres(tmp_path: Path, kind: str):
    relative = network(tmp_path, "fine", depth_kind=kind, gain=37.0, width=640, height=480)
    metric = network(tmp_path, "coarse", gain=1.2, width=160, height=120)
    paired = PairedNetwork(relative, metric)
    image, depth = view()
    answer = paired.infer(image, CAMERA)
    assert answer.valid
    assert answer.depth.shape == (120, 160)  # the relative network's resolution
    truth = 1.2 * cv2.resize(depth, (160, 120), interpolation=cv2.INTER_AREA)
    assert np.median(answer.depth / truth) == pytest.approx(1.0, abs=0.01)
    assert np.percentile(np.abs(np.log(answer.depth / truth)), 95) < 0.03
    assert paired.bias_sigma == metric.bias_sigma > 0
    assert paired.name == "nested:fine,coarse"
    assert paired.counters == {"unpaired": 0}


@pytest.mark.parametrize("kind", ["relative", "inverse_relative"])
def test_sky_has_no_depth_in_a_pair_either_and_bends_nothing(tmp_path: Path, kind: str):
    what = TinyNetwork(name="sees_sky", depth_kind=kind, width=640, height=480)
    graph = tiny_graph(what)
    sign = "Neg" if kind == "inverse_relative" else "Identity"
    graph.node.append(helper.make_node(sign, ["log_depth"], ["sky"]))  # beyond 2.7 m, most of one wall
    graph.output.append(helper.make_tensor_value_info("sky", TensorProto.FLOAT, [1, 1, 120, 160]))
    save(tmp_path / "sky.onnx", graph, replace(what.card(), sky_output="sky", sky_limit=1.0))
    paired = PairedNetwork(OnnxNetwork(tmp_path / "sky.onnx"), network(tmp_path, "m", width=160, height=120))
    image, depth = view()
    answer = paired.infer(image, CAMERA)
    truth = cv2.resize(depth, (160, 120), interpolation=cv2.INTER_AREA)
    assert not answer.depth[truth > 2.8].any()
    seen = truth < 2.6
    assert np.percentile(np.abs(np.log(answer.depth[seen] / truth[seen])), 95) < 0.03


@pytest.mark.parametrize("misbehaviour", ["nan", "zero", "negative", "constant"])
def test_the_metric_network_stands_alone_where_the_relative_one_fails(tmp_path: Path, misbehaviour: str):
    relative = network(tmp_path, "bad", depth_kind="inverse_relative", misbehaviour=misbehaviour)
    metric = network(tmp_path, "good")
    paired = PairedNetwork(relative, metric)
    image, _ = view()
    assert np.array_equal(paired.infer(image, CAMERA).depth, metric.infer(image, CAMERA).depth)
    assert paired.counters == {"unpaired": 1}


def test_the_metric_answer_outlives_a_relative_network_that_raises(tmp_path: Path, monkeypatch, caplog):
    relative = network(tmp_path, "r", depth_kind="inverse_relative", descriptor=True)
    metric = network(tmp_path, "m", descriptor=True)
    paired, (image, _) = PairedNetwork(relative, metric), view()

    def fails(rgb: np.ndarray) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(relative, "raw", fails)
    answer = paired.infer(image, CAMERA)
    assert np.array_equal(answer.depth, metric.infer(image, CAMERA).depth)
    assert answer.descriptor.size == 0  # the metric network's can't be compared with the pair's
    assert paired.counters == {"unpaired": 1}
    assert "r fails, m stands alone: out of memory" in caplog.text


@pytest.mark.parametrize(
    ("fits", "says"),
    [
        ([(False, False)] * 4, ""),  # too few to tell
        ([(True, False), (False, False)] * 3, ""),
        ([(True, False)] * 2 + [(False, False)] * 3, "r fits m in 2 of 5 images: m stands alone in the oth"),
        ([(False, True)] * 6 + [(False, False)] * 2, "with depth_kind: inverse_relative in its card it"),
        ([(False, False)] * 5 + [(True, False)] * 20, ""),  # the last twenty count
    ],
)
def test_a_pair_is_doubted_where_it_fits_less_than_half_of_the_last_images(tmp_path: Path, fits, says: str):
    paired = PairedNetwork(network(tmp_path, "r", depth_kind="relative"), network(tmp_path, "m"))
    paired._fits.extend(fits)
    assert (says in paired.doubt) if says else not paired.doubt


def test_a_pairs_descriptors_come_from_one_network_whether_it_fits_or_not(tmp_path: Path):
    image, _ = view()
    for relative_has_one in (True, False):
        for misbehaviour in ("", "constant"):
            relative = network(
                tmp_path,
                f"r{relative_has_one}{misbehaviour}",
                depth_kind="inverse_relative",
                descriptor=relative_has_one,
                confidence=True,
                misbehaviour=misbehaviour,
                width=640,
                height=480,
            )
            metric = network(tmp_path, "m", descriptor=True, confidence=True)
            answer = PairedNetwork(relative, metric).infer(image, CAMERA)
            its = relative.raw(image)[0] if relative_has_one else metric.raw(image)[0]
            expected = its.descriptor / np.linalg.norm(its.descriptor)
            assert answer.descriptor == pytest.approx(expected, abs=1e-6)
            assert bool(answer.confidence.size) == (misbehaviour == "")


def test_a_pair_names_each_provider_and_adds_up_what_runs_elsewhere(tmp_path: Path):
    relative, metric = network(tmp_path, "r", depth_kind="relative"), network(tmp_path, "m")
    assert PairedNetwork(relative, metric).provider == "CPUExecutionProvider"
    relative.provider = "CUDAExecutionProvider"
    relative.counters, metric.counters = {"nodes_elsewhere": 2}, {"nodes_elsewhere": 3}
    paired = PairedNetwork(relative, metric)
    assert paired.provider == "CUDAExecutionProvider, CPUExecutionProvider"
    assert paired.counters == {"unpaired": 0, "nodes_elsewhere": 5}


def test_without_metric_depth_there_is_none(tmp_path: Path):
    relative = network(tmp_path, "good", depth_kind="inverse_relative")
    paired = PairedNetwork(relative, network(tmp_path, "bad", misbehaviour="nan"))
    answer = paired.infer(view()[0], CAMERA)
    assert not answer.valid
    assert "NaN" in answer.reason


def test_each_network_must_be_of_its_kind(tmp_path: Path):
    relative, metric = network(tmp_path, "r", depth_kind="relative"), network(tmp_path, "m")
    with pytest.raises(ModelError, match="first network must be a relative one"):
        PairedNetwork(metric, metric)
    with pytest.raises(ModelError, match="second network must be a metric one"):
        PairedNetwork(relative, relative)


@pytest.mark.realdata
def test_depth_anything_in_fastdepths_metres(shared: Path, fastdepth: Path, redkitchen: Path):
    relative = OnnxNetwork(shared / "models" / "depth_anything_v2_small_252x336_int8.onnx")
    paired = PairedNetwork(relative, OnnxNetwork(fastdepth))
    errors = []
    for i in range(0, 1000, 199):
        image = cv2.imread(str(redkitchen / f"frame-{i:06d}.color.jpg"))
        kinect = cv2.imread(str(redkitchen / f"frame-{i:06d}.depth.png"), cv2.IMREAD_UNCHANGED) / 1000.0
        answer = paired.infer(np.ascontiguousarray(image[:, :, ::-1]), Camera(640, 480, 525, 525, 320, 240))
        truth = cv2.resize(kinect, answer.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
        seen = (truth > 0.3) & (answer.depth > 0)
        errors.append(np.mean(np.abs(answer.depth[seen] / truth[seen] - 1)))
    assert paired.counters == {"unpaired": 0}
    assert np.mean(errors) < 0.22


def test_where_inverse_depth_runs_to_nothing_there_is_no_depth(tmp_path: Path):
    """What a relative network takes for infinitely far the metric one never saw so far."""
    what = TinyNetwork(name="r", depth_kind="inverse_relative", width=640, height=480)
    graph = tiny_graph(what)
    graph.output[0].name = "moved"
    for name, number in (("least", 0.3), ("drop", -0.24)):  # beyond 3.3 m of 4 it falls off
        value = helper.make_tensor(name, TensorProto.FLOAT, [1], [number])
        graph.node.append(helper.make_node("Constant", [], [name], value=value))
    graph.node.append(helper.make_node("Less", ["depth", "least"], ["far"]))
    graph.node.append(helper.make_node("Add", ["depth", "drop"], ["fallen"]))
    graph.node.append(helper.make_node("Where", ["far", "fallen", "depth"], ["moved"]))
    save(tmp_path / "r.onnx", graph, replace(what.card(), depth_output="moved"))
    metric = network(tmp_path, "m", width=160, height=120)
    image, depth = view()
    answer = PairedNetwork(OnnxNetwork(tmp_path / "r.onnx"), metric).infer(image, CAMERA)
    truth = cv2.resize(depth, (160, 120), interpolation=cv2.INTER_AREA)
    assert answer.valid
    assert not answer.depth[truth > 3.5].any()
    assert answer.depth.max() <= 1.5 * np.percentile(metric.infer(image, CAMERA).depth, 99)
    seen = truth < 3.0
    assert np.percentile(np.abs(np.log(answer.depth[seen] / truth[seen])), 95) < 0.05


@pytest.mark.parametrize("kind", ["relative", "inverse_relative"])
def test_the_metric_network_s_sky_has_no_depth_in_a_pair(tmp_path: Path, kind: str):
    """A relative network that knows of no sky puts a surface there."""
    what = TinyNetwork(name="m_sky", width=640, height=480)
    graph = tiny_graph(what)
    graph.node.append(helper.make_node("Identity", ["log_depth"], ["sky"]))  # beyond 2.7 m
    graph.output.append(helper.make_tensor_value_info("sky", TensorProto.FLOAT, [1, 1, 120, 160]))
    save(tmp_path / "m.onnx", graph, replace(what.card(), sky_output="sky", sky_limit=1.0))
    relative = network(tmp_path, "r", depth_kind=kind, width=640, height=480)
    paired = PairedNetwork(relative, OnnxNetwork(tmp_path / "m.onnx"))
    image, depth = view()
    answer = paired.infer(image, CAMERA)
    truth = cv2.resize(depth, (160, 120), interpolation=cv2.INTER_AREA)
    assert paired.counters["unpaired"] == 0
    assert not answer.depth[truth > 2.8].any()
    assert (answer.depth[truth < 2.6] > 0).all()
