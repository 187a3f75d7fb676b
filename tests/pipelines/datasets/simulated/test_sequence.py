"""Opening, options, caching and repair of simulated sequences."""

from pathlib import Path

import numpy as np
import pytest

from pipelines.datasets.simulated import SimulatedSequence
from pipelines.datasets.simulated.scenes import SCENES
from pipelines.errors import ConfigError, DatasetError

TINY = {"frames": 2, "scale": 0.12}


def files(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.glob("*.npz"))}


def test_two_generations_are_the_same_byte_for_byte(tmp_path):
    a = SimulatedSequence("street", cache=tmp_path / "a", degrade="all", **TINY)
    b = SimulatedSequence("street", cache=tmp_path / "b", degrade="all", **TINY)
    assert len(list(tmp_path.glob("a/*/*.npz"))) == 5  # two exact, two degraded, the truth
    for folder in (tmp_path / "a").iterdir():
        assert files(folder) == files(tmp_path / "b" / folder.name)
    assert a.name == b.name == "street-degraded"


def test_another_seed_is_another_street(tmp_path):
    a = SimulatedSequence("street", cache=tmp_path, seed=1, **TINY)
    b = SimulatedSequence("street", cache=tmp_path, seed=2, **TINY)
    assert a.root != b.root
    assert (a.read(0).image != b.read(0).image).mean() > 0.2


def test_second_opening_renders_nothing(street, cache):
    calls = []
    again = SimulatedSequence(
        "simulated:street", frames=4, scale=0.3, cache=cache, progress=lambda *c: calls.append(c)
    )
    assert calls == []
    assert again.root == street.root
    assert (again.read(3).image == street.read(3).image).all()


def test_progress_counts_the_frames(tmp_path):
    calls = []
    SimulatedSequence("room", cache=tmp_path, progress=lambda *c: calls.append(c), **TINY)
    assert calls == [(1, 2), (2, 2)]


@pytest.mark.parametrize("damage", ["cut", "gone", "no manifest"])
def test_damaged_folder_is_made_again(tmp_path, damage):
    first = SimulatedSequence("room", cache=tmp_path, **TINY)
    good = files(first.root)
    victim = first.root / "000001.npz"
    if damage == "cut":
        victim.write_bytes(victim.read_bytes()[:1000])
    elif damage == "gone":
        victim.unlink()
    else:
        (first.root / "complete.json").unlink()
    again = SimulatedSequence("room", cache=tmp_path, **TINY)
    assert files(again.root) == good
    assert [p.name for p in tmp_path.iterdir()] == [first.root.name]


@pytest.mark.parametrize("degrade", [None, "noise,disparity"])
def test_flipped_bytes_are_found_when_read_and_repaired(tmp_path, degrade):
    sequence = SimulatedSequence("room", cache=tmp_path, degrade=degrade, **TINY)
    victim = sequence.root / "000001.npz"
    good = victim.read_bytes()
    bad = bytearray(good)
    bad[len(bad) // 2] ^= 0xFF
    victim.write_bytes(bytes(bad))
    frame = sequence.read(1)
    assert victim.read_bytes() == good
    assert frame.index == 1


def test_interrupted_generation_leaves_nothing_that_looks_whole(tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        SimulatedSequence("room", cache=tmp_path, progress=stop, **TINY)
    assert list(tmp_path.iterdir()) == []
    assert len(SimulatedSequence("room", cache=tmp_path, **TINY)) == 2


def test_cache_follows_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("DYOB_CACHE", str(tmp_path))
    sequence = SimulatedSequence.open("simulated:room", **TINY)
    assert sequence.root.parent == tmp_path / "simulated"


def test_provide_chooses_the_inputs(street, cache):
    full = street.read(1)
    assert full.image_right is None
    assert full.flow_prev_to_curr_px is not None
    stereo = SimulatedSequence("street", frames=4, scale=0.3, cache=cache, provide="right").read(1)
    assert stereo.depth_m is stereo.flow_prev_to_curr_px is stereo.instance_labels is None
    assert stereo.image_right.shape == full.image.shape
    assert (stereo.image == full.image).all()


def test_frames_are_as_the_contract_says(exact):
    frame, camera = exact.read(2), exact.camera
    shape = (camera.height, camera.width)
    assert frame.index == 2
    assert frame.timestamp_s == exact.timestamps_s[2]
    assert frame.image.shape == (*shape, 3)
    assert frame.image.dtype == frame.image_right.dtype == np.uint8
    assert frame.depth_m.dtype == frame.flow_prev_to_curr_px.dtype == np.float32
    assert frame.instance_labels.dtype == np.int32
    assert exact.dataset == "simulated"
    assert exact.layout
    with pytest.raises(IndexError):
        exact.read(4)


def test_pictures_are_bright_varied_and_textured(exact):
    """Not black, not washed out, and full of corners all over for a feature detector."""
    import cv2

    grey = cv2.cvtColor(exact.read(0).image, cv2.COLOR_RGB2GRAY)
    assert 60 < grey.mean() < 190
    assert grey.std() > 25
    corners = cv2.goodFeaturesToTrack(grey, 500, 0.01, 4)[:, 0]
    assert len(corners) > 250
    cells = {(int(8 * x / grey.shape[1]), int(3 * y / grey.shape[0])) for x, y in corners}
    assert len(cells) >= 17  # of 24


def test_scenes_have_the_sizes_that_are_promised():
    street, room, demo = SCENES["street"], SCENES["room"], SCENES["demo"]
    assert (street.camera.width, street.camera.height, street.fps) == (1242, 375, 10)
    assert (street.camera.fx, street.camera.bf) == (721.5377, 387.5744)
    assert (room.camera.width, room.camera.height, room.fps) == (640, 480, 20)
    assert (demo.camera.width, demo.camera.height) == (621, 188)
    assert demo.camera.baseline_m == pytest.approx(street.camera.baseline_m)


def test_unknown_scene_names_the_valid_ones(tmp_path):
    with pytest.raises(
        DatasetError, match=r"'beach'.*street, room, crossing, loop, long, static, demo, kitti_0000"
    ):
        SimulatedSequence("simulated:beach", cache=tmp_path)


@pytest.mark.parametrize(
    "options", [{"frames": 0}, {"seed": -1}, {"scale": 9.0}, {"provide": "sound"}]
)
def test_bad_options_are_refused(tmp_path, options):
    with pytest.raises(ConfigError, match=r"found|unknown input 'sound'"):
        SimulatedSequence("room", cache=tmp_path, **options)


def test_matches_specs_and_no_folders():
    assert SimulatedSequence.matches("simulated:street")
    assert SimulatedSequence.matches("simulated")
    assert not SimulatedSequence.matches("data/simulated")
    assert not SimulatedSequence.matches("simulated_results")
