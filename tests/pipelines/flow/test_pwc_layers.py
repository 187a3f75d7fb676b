"""Each layer of PWC-Net against a reference of its own, and the whole against another assembly.

The references know the paper and the published table of layers, written out here a second time.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

torch = pytest.importorskip("torch", reason="needs torch; `python3 -m app test` installs it")

from torch.nn import functional as F  # noqa: E402, N812

from pipelines.flow.pwc_layers import PwcNetwork, _volume, correlate, warp  # noqa: E402

# Name -> inputs, outputs, stride, dilation, and size of the output on an image of 64 x 128.
CONVOLUTIONS = {
    "conv1a": (3, 16, 2, 1, (32, 64)),
    "conv1aa": (16, 16, 1, 1, (32, 64)),
    "conv1b": (16, 16, 1, 1, (32, 64)),
    "conv2a": (16, 32, 2, 1, (16, 32)),
    "conv2aa": (32, 32, 1, 1, (16, 32)),
    "conv2b": (32, 32, 1, 1, (16, 32)),
    "conv3a": (32, 64, 2, 1, (8, 16)),
    "conv3aa": (64, 64, 1, 1, (8, 16)),
    "conv3b": (64, 64, 1, 1, (8, 16)),
    "conv4a": (64, 96, 2, 1, (4, 8)),
    "conv4aa": (96, 96, 1, 1, (4, 8)),
    "conv4b": (96, 96, 1, 1, (4, 8)),
    "conv5a": (96, 128, 2, 1, (2, 4)),
    "conv5aa": (128, 128, 1, 1, (2, 4)),
    "conv5b": (128, 128, 1, 1, (2, 4)),
    "conv6aa": (128, 196, 2, 1, (1, 2)),
    "conv6a": (196, 196, 1, 1, (1, 2)),
    "conv6b": (196, 196, 1, 1, (1, 2)),
    "dc_conv1": (565, 128, 1, 1, (16, 32)),
    "dc_conv2": (128, 128, 1, 2, (16, 32)),
    "dc_conv3": (128, 128, 1, 4, (16, 32)),
    "dc_conv4": (128, 96, 1, 8, (16, 32)),
    "dc_conv5": (96, 64, 1, 16, (16, 32)),
    "dc_conv6": (64, 32, 1, 1, (16, 32)),
}
SIZES = {6: (1, 2), 5: (2, 4), 4: (4, 8), 3: (8, 16), 2: (16, 32)}
DECODER_INPUTS = {6: 81, 5: 213, 4: 181, 3: 149, 2: 117}
for level, inputs in DECODER_INPUTS.items():
    for number, (added, outputs) in enumerate(
        [(0, 128), (128, 128), (256, 96), (352, 64), (416, 32)]
    ):
        CONVOLUTIONS[f"conv{level}_{number}"] = (inputs + added, outputs, 1, 1, SIZES[level])
PLAIN = {"dc_conv7": 32} | {f"predict_flow{k}": n + 448 for k, n in DECODER_INPUTS.items()}
DOUBLING = {f"deconv{k}": 2 for k in SIZES} | {
    f"upfeat{k}": n + 448 for k, n in DECODER_INPUTS.items() if k > 2
}


def rand(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def costs_by_loops(first: np.ndarray, second: np.ndarray, radius: int = 4) -> np.ndarray:
    """(81, H, W) of (C, H, W): pixel by pixel, displacement by displacement."""
    channels, height, width = first.shape
    side = 2 * radius + 1
    costs = np.zeros((side * side, height, width))
    for y in range(height):
        for x in range(width):
            for k in range(side * side):
                yy, xx = y + k // side - radius, x + k % side - radius
                if 0 <= yy < height and 0 <= xx < width:
                    costs[k, y, x] = first[:, y, x] @ second[:, yy, xx] / channels
    return costs


def warp_by_scipy(features: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """(C, H, W) read at x + flow, where that lies inside, else 0."""
    _, height, width = features.shape
    v, u = np.mgrid[:height, :width]
    v, u = v + flow[1].astype(float), u + flow[0].astype(float)
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    return np.stack([map_coordinates(f.astype(float), [v, u], order=1) for f in features]) * inside


def test_cost_volume_by_loops() -> None:
    first, second = rand(0, 7, 6, 11), rand(1, 7, 6, 11)
    costs = correlate(torch.tensor(first)[None], torch.tensor(second)[None])
    assert costs.shape == (1, 81, 6, 11)
    np.testing.assert_allclose(costs[0].numpy(), costs_by_loops(first, second), atol=1e-6)


def test_cost_volume_peaks_at_the_displacement() -> None:
    first = torch.tensor(rand(2, 64, 20, 20))[None]
    second = torch.roll(first, (2, -3), dims=(2, 3))  # what was at x is at x + (-3, 2)
    best = correlate(first, second)[0, :, 6:-6, 6:-6].argmax(0)
    assert (best == (2 + 4) * 9 + (-3 + 4)).all()


def test_negative_costs_are_damped() -> None:
    """Features of natural pairs have hardly any, so that the whole pass does not show it."""
    first, second = torch.tensor(rand(0, 1, 7, 6, 11)), torch.tensor(rand(1, 1, 7, 6, 11))
    costs = correlate(first, second)
    assert (costs < 0).float().mean() > 0.1
    torch.testing.assert_close(_volume(first, second), torch.where(costs > 0, costs, 0.1 * costs))


def test_cost_volume_of_a_batch_is_that_of_each() -> None:
    first, second = torch.tensor(rand(3, 2, 5, 4, 6)), torch.tensor(rand(4, 2, 5, 4, 6))
    both = correlate(first, second)
    torch.testing.assert_close(both[1:], correlate(first[1:], second[1:]))


@pytest.mark.parametrize("size_px", [0.3, 4.0])
def test_warping_by_scipy(size_px: float) -> None:
    features, flow = rand(5, 3, 12, 17), size_px * rand(6, 2, 12, 17)
    warped = warp(torch.tensor(features)[None], torch.tensor(flow)[None])[0].numpy()
    expected = warp_by_scipy(features, flow)
    empty = (expected == 0).all(axis=0)
    assert 0.02 < empty.mean() < 0.9
    np.testing.assert_array_equal((warped == 0).all(axis=0), empty)
    np.testing.assert_allclose(warped, expected, atol=3e-5)


def test_warping_by_whole_pixels_moves_and_empties() -> None:
    features = torch.tensor(rand(7, 2, 8, 9))[None]
    flow = torch.tensor([2.0, -1.0]).view(1, 2, 1, 1).expand(1, 2, 8, 9)
    warped = warp(features, flow)
    torch.testing.assert_close(warped[..., 1:, :-2], features[..., :-1, 2:], atol=1e-5, rtol=0)
    assert (warped[..., 0, :] == 0).all()
    assert (warped[..., -2:] == 0).all()
    still = warp(features, torch.zeros(1, 2, 8, 9))
    torch.testing.assert_close(still, features, atol=1e-5, rtol=0)  # the border stays too


def test_every_layer_has_the_published_shape() -> None:
    expected = {}
    for name, (inputs, outputs, *_) in CONVOLUTIONS.items():
        expected[f"{name}.0.weight"], expected[f"{name}.0.bias"] = (
            (outputs, inputs, 3, 3),
            (outputs,),
        )
    for name, inputs in PLAIN.items():
        expected[f"{name}.weight"], expected[f"{name}.bias"] = (2, inputs, 3, 3), (2,)
    for name, inputs in DOUBLING.items():
        expected[f"{name}.weight"], expected[f"{name}.bias"] = (inputs, 2, 4, 4), (2,)
    found = {name: tuple(value.shape) for name, value in PwcNetwork().state_dict().items()}
    assert found == expected
    assert sum(int(np.prod(shape)) for shape in found.values()) == 9_374_340


def test_every_layer_has_the_published_stride_dilation_and_output_size() -> None:
    network, sizes = PwcNetwork().eval(), {}
    for name, layer in network.named_children():
        layer.register_forward_hook(
            lambda _, __, output, name=name: sizes.update({name: tuple(output.shape[1:])})
        )
    with torch.inference_mode():
        flow = network(*torch.rand(2, 1, 3, 64, 128))
    assert flow.shape == (1, 2, 16, 32)
    for name, (_, outputs, stride, dilation, size) in CONVOLUTIONS.items():
        layer, activation = network.get_submodule(name)
        assert (layer.stride, layer.dilation) == ((stride, stride), (dilation, dilation)), name
        assert activation.negative_slope == 0.1
        assert sizes.pop(name) == (outputs, *size), name
    for k, (height, width) in SIZES.items():
        assert sizes.pop(f"predict_flow{k}") == (2, height, width)
        for name in (f"deconv{k}", f"upfeat{k}") if k > 2 else ():
            assert sizes.pop(name) == (2, 2 * height, 2 * width)
    assert sizes == {"dc_conv7": (2, 16, 32)}


def reference_pass(weights: dict, first: np.ndarray, second: np.ndarray) -> dict[str, np.ndarray]:
    """The published forward pass, level by level, in float64; flows by name, and the last one."""
    weights = {name: value.double() for name, value in weights.items()}

    def conv(x, name, stride=1, dilation=1):
        w, b = weights[f"{name}.0.weight"], weights[f"{name}.0.bias"]
        return F.leaky_relu(F.conv2d(x, w, b, stride, dilation, dilation), 0.1)

    def pyramid(image):
        levels, x = {}, torch.tensor(image, dtype=torch.float64)[None]
        for k in (1, 2, 3, 4, 5):
            x = conv(conv(conv(x, f"conv{k}a", 2), f"conv{k}aa"), f"conv{k}b")
            levels[k] = x
        levels[6] = conv(conv(conv(x, "conv6aa", 2), "conv6a"), "conv6b")
        return levels

    def plain(x, name):
        return F.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], 1, 1)

    def double(x, name):
        w, b = weights[f"{name}.weight"], weights[f"{name}.bias"]
        return F.conv_transpose2d(x, w, b, 2, 1)

    one, two, flows = pyramid(first), pyramid(second), {}
    for k, scale in ((6, None), (5, 0.625), (4, 1.25), (3, 2.5), (2, 5.0)):
        other = two[k][0].numpy()
        if scale is not None:
            up = double(flows[f"flow{k + 1}"], f"deconv{k + 1}")
            hints = double(x, f"upfeat{k + 1}")  # noqa: F821
            flows[f"warp{k}"] = up * scale
            other = warp_by_scipy(other, (up * scale)[0].numpy())
        costs = torch.tensor(costs_by_loops(one[k][0].numpy(), other))[None]
        x = torch.where(costs > 0, costs, 0.1 * costs)
        if scale is not None:
            x = torch.cat([x, one[k], up, hints], 1)
        for i in range(5):
            x = torch.cat([conv(x, f"conv{k}_{i}"), x], 1)
        flows[f"flow{k}"] = plain(x, f"predict_flow{k}")
    for i, dilation in enumerate((1, 2, 4, 8, 16, 1), 1):
        x = conv(x, f"dc_conv{i}", dilation=dilation)
    flows["flow"] = flows["flow2"] + plain(x, "dc_conv7")
    return {name: value[0].numpy() for name, value in flows.items()}


def test_the_whole_pass_against_another_assembly(pwc_weights) -> None:
    weights = torch.load(pwc_weights, weights_only=True)
    network = PwcNetwork().eval()
    network.load_state_dict(weights)
    images = np.random.default_rng(8).uniform(size=(2, 3, 64, 128)).astype(np.float32)
    with torch.inference_mode():
        flow = network(*torch.tensor(images)[:, None])[0].numpy()
    expected = reference_pass(weights, *images)
    # The comparison means something only if the flows move the warping, and not all of it out.
    for k in (5, 4, 3, 2):
        reach = np.abs(expected[f"warp{k}"])
        assert 0.05 < np.median(reach) < 20, k
    assert np.abs(expected["flow"] - expected["flow2"]).mean() > 0.01  # the context network's part
    np.testing.assert_allclose(flow, expected["flow"], atol=1e-4 * np.abs(expected["flow"]).max())
