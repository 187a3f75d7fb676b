"""PWC-Net as a method: conventions around the network, and the reading of its weights.

The published weights are not at hand here; files of random ones with their names are.
"""

from __future__ import annotations

import hashlib
import pickle
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.config import FlowConfig
from pipelines.errors import ModelError
from pipelines.flow import load_flow
from pipelines.flow.pwc_net import PwcNetFlow, load_network

torch = pytest.importorskip("torch", reason="needs torch; `python3 -m app test` installs it")


@pytest.fixture(scope="module")
def method(pwc_weights: Path) -> PwcNetFlow:
    return PwcNetFlow(pwc_weights)


@pytest.fixture
def weights(pwc_weights: Path) -> dict:
    """The state dict, free to be damaged."""
    return torch.load(pwc_weights, weights_only=True)


def images(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (2, height, width, 3), dtype=np.uint8)


def constant_method(weights: dict, folder: Path, du: float, dv: float) -> PwcNetFlow:
    """A network that says (du, dv) everywhere, in its own units."""
    still = {name: torch.zeros_like(value) for name, value in weights.items()}
    still["predict_flow2.bias"] = torch.tensor([du, dv])
    torch.save(still, folder / "constant.pth.tar")
    return PwcNetFlow(folder / "constant.pth.tar")


@pytest.mark.parametrize(("height", "width"), [(64, 128), (75, 131), (127, 65)])
def test_the_answer_is_in_pixels_of_the_given_image(weights, tmp_path, height, width) -> None:
    """One unit is 20 pixels of the image resized to multiples of 64."""
    flow = constant_method(weights, tmp_path, 0.5, -0.25).compute(*images(height, width))
    resized = [-(-side // 64) * 64 for side in (height, width)]
    assert flow.shape == (height, width, 2)
    np.testing.assert_allclose(flow[..., 0], 0.5 * 20 * width / resized[1], rtol=1e-5)
    np.testing.assert_allclose(flow[..., 1], -0.25 * 20 * height / resized[0], rtol=1e-5)


def test_the_network_sees_blue_green_red_from_0_to_1(method) -> None:
    seen = []
    hook = method._network.conv1a.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    rgb = np.zeros((64, 128, 3), np.uint8)
    rgb[:] = (255, 102, 0)
    grey = np.full((64, 128), 51, np.uint8)
    method.compute(rgb, rgb)
    method.compute(grey, grey)
    hook.remove()
    for batch, bgr in zip(seen, ((0.0, 0.4, 1.0), (0.2, 0.2, 0.2)), strict=True):
        assert batch.shape == (2, 3, 64, 128)
        expected = torch.tensor(bgr).view(1, 3, 1, 1).expand_as(batch)
        torch.testing.assert_close(batch.cpu(), expected)


def test_grey_is_three_equal_channels(method) -> None:
    gray = images(70, 100)[..., 0]
    flow = method.compute(*gray)
    np.testing.assert_allclose(flow, method.compute(*np.repeat(gray[..., None], 3, 3)), atol=1e-4)


def test_the_flow_of_odd_sizes_is_that_of_the_resized_images(method) -> None:
    pair = images(100, 180, seed=1)
    flow = method.compute(*pair)
    resized = np.stack([cv2.resize(image, (192, 128)) for image in pair])
    expected = method.compute(*resized)[..., :] * (180 / 192, 100 / 128)
    # Reading a quarter-size flow at two sizes rounds its steep places differently.
    difference = np.linalg.norm(cv2.resize(expected, (180, 100)) - flow, axis=2)
    assert np.median(difference) < 0.03 * np.median(np.linalg.norm(flow, axis=2))
    assert np.isfinite(flow).all()


@pytest.mark.slow
def test_a_frame_of_kitti(method) -> None:
    pair = images(375, 1242)
    flow = method.compute(*pair)
    assert (flow.shape, flow.dtype) == ((375, 1242, 2), np.float32)
    assert np.isfinite(flow).all()
    assert flow.std() > 0.1
    np.testing.assert_array_equal(flow, method.compute(*pair))


@pytest.mark.parametrize("form", ["nested", "before zip", "half", "more than weights"])
def test_files_as_torch_writes_them(weights, method, tmp_path, form) -> None:
    path = tmp_path / "pwc_net_chairs.pth.tar"
    if form == "nested":
        torch.save({"epoch": 3, "state_dict": weights}, path)
    elif form == "before zip":  # torch 0.4, with which the published weights were written
        torch.save(weights, path, _use_new_zipfile_serialization=False)
        assert not zipfile.is_zipfile(path)
    elif form == "half":
        torch.save({name: value.half() for name, value in weights.items()}, path)
    else:
        held = {name: torch.nn.Parameter(value) for name, value in weights.items()}
        torch.save({"state_dict": held, "optimizer": {"lr": 0.1}}, path)
    network = load_network(path)
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    tolerance = 1e-2 if form == "half" else 0
    for name, value in network.state_dict().items():
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, weights[name], rtol=tolerance, atol=tolerance)


def test_a_checksum_is_kept(pwc_weights) -> None:
    right = hashlib.sha256(pwc_weights.read_bytes()).hexdigest()
    load_network(pwc_weights, right.upper())
    with pytest.raises(ModelError, match=f"expected sha256 {'0' * 64}, found {right}"):
        load_network(pwc_weights, "0" * 64)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda w: w.pop("conv1aa.0.weight"), r"conv1aa\.0\.weight missing"),
        (lambda w: w.update(head=torch.zeros(1)), "head unknown"),
        (
            lambda w: [w.pop(k) for k in list(w)[4:]],
            r"conv1b\.0\.weight, .* and 1\d\d more missing",
        ),
        (
            lambda w: w.update({"conv3b.0.bias": torch.zeros(65)}),
            r"has shape \(65,\), expected \(64",
        ),
        (lambda w: w["deconv3.weight"].view(-1)[5:6].fill_(torch.nan), r"deconv3\.weight holds"),
        (lambda w: w.update({"conv1a.0.bias": 7}), "expected names with tensors"),
        (lambda w: w.clear(), "and 125 more missing"),
    ],
)
def test_other_weights_are_refused_by_name(weights, tmp_path, damage, words) -> None:
    damage(weights)
    torch.save(weights, tmp_path / "other.pth")
    with pytest.raises(ModelError, match=words) as raised:
        load_network(tmp_path / "other.pth")
    assert str(tmp_path / "other.pth") in str(raised.value)


class Harmful:
    """Unpickling it as usual would create a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_no_code_of_a_file_is_run(weights, tmp_path) -> None:
    victim = tmp_path / "harmed"
    weights["conv1a.0.bias"] = Harmful(victim)
    torch.save(weights, tmp_path / "zip.pth")
    (tmp_path / "plain.pth").write_bytes(pickle.dumps(Harmful(victim), protocol=2))
    for name in ("zip.pth", "plain.pth"):
        with pytest.raises(ModelError, match="cannot be read"):
            load_network(tmp_path / name)
    assert not victim.exists()
    pickle.loads((tmp_path / "plain.pth").read_bytes())
    assert victim.exists()  # it would have


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 500, b"<html>not found</html>", b"PK\3\4" + b"x" * 99]
)
def test_damaged_files_are_one_sentence(tmp_path, content) -> None:
    path = tmp_path / "pwc_net.pth.tar"
    path.write_bytes(content)
    with pytest.raises(ModelError, match="cannot be read") as raised:
        load_network(path)
    assert "\n" not in str(raised.value)
    assert "models add pwc_net FILE" in str(raised.value)


def test_a_download_that_broke_off(pwc_weights, tmp_path) -> None:
    whole = pwc_weights.read_bytes()
    for share in (0.01, 0.5, 0.999):
        (tmp_path / "part.pth").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ModelError, match="cannot be read"):
            load_network(tmp_path / "part.pth")


def test_a_missing_file_says_how_to_get_it(tmp_path) -> None:
    words = "is missing; take .*models add pwc_net FILE.*--set flow.model=FILE"
    with pytest.raises(ModelError, match=words):
        load_flow(FlowConfig(name="pwc_net"))
    for path in (tmp_path / "nowhere.pth", tmp_path):
        with pytest.raises(ModelError, match=f"found nothing at {path}; take"):
            load_flow(FlowConfig(name="pwc_net", model=str(path)))


def test_without_torch_it_says_what_to_do(monkeypatch, pwc_weights) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ModelError, match=r"under \[torch\] in environment.txt, or choose"):
        PwcNetFlow(pwc_weights)
