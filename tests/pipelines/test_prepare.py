"""`prepare`: its files read back as what was computed, and nothing is computed twice."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines import prepare_steps
from pipelines.datasets import open_sequence
from pipelines.depth import StereoDepth, to_gray
from pipelines.errors import ConfigError, DatasetError
from pipelines.flow.dis import DisFlow
from pipelines.io.config import load_config
from pipelines.object_types import Detections
from pipelines.prepare import prepare

N = 4
FAST = load_config(overrides=["flow.preset=ultrafast"])


class Detector:
    """Two instances whose place is that of the frame; it counts its calls."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.seen: list[int] = []
        self.stop_after = stop_after

    def detect(self, frame) -> Detections:
        if len(self.seen) == self.stop_after:
            raise KeyboardInterrupt
        self.seen.append(frame.index)
        labels = np.zeros(frame.image.shape[:2], np.int32)
        labels[5:9, 10 + frame.index : 20] = 3
        labels[20:30, 40:50] = 300  # more than 8 bits hold
        return Detections(
            labels,
            np.array([3, 300], np.int32),
            np.array(["car", "person"]),
            np.array([0.75, 0.5]),
        )


@pytest.fixture
def stereo_folder(stereo_street, tmp_path: Path) -> Path:
    """Stereo pairs as a person would record them: images/, right/, camera.yaml."""
    root = tmp_path / "drive"
    camera = stereo_street.camera
    for k in range(N):
        frame = stereo_street.read(k)
        for name, image in (("images", frame.image), ("right", frame.image_right)):
            (root / name).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(root / name / f"{k}.png"), image[..., ::-1])
    (root / "camera.yaml").write_text(
        f"# mine\nfx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\n"
        f"bf: {camera.bf}\nfps: 10\n"
    )
    return root


def times_of(root: Path) -> dict[str, int]:
    return {
        str(path.relative_to(root)): path.stat().st_mtime_ns
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def test_what_is_read_back_is_what_was_computed(stereo_folder: Path) -> None:
    raw = open_sequence(stereo_folder)
    frames = [raw.read(k) for k in range(N)]
    progress: list[tuple[int, int]] = []
    detector = Detector()
    done = prepare(raw, FAST, detector=detector, progress=lambda k, n: progress.append((k, n)))
    assert done.folder == stereo_folder
    assert done.made == {"depth": N, "flow": N - 1, "masks": N}
    assert done.kept == {"depth": 0, "flow": 0, "masks": 0}
    assert progress == [(k + 1, N) for k in range(N)]
    prepared = open_sequence(stereo_folder)
    assert prepared.camera == raw.camera
    assert (stereo_folder / "camera.yaml").read_text().startswith("# mine\n")
    stereo, dis = StereoDepth(FAST.depth, raw.camera), DisFlow("ultrafast")
    for k in range(N):
        frame = prepared.read(k)
        assert frame.image_right is None
        assert frame.depth_m is not None
        disparity = stereo.disparity(frames[k].image, frames[k].image_right)
        read = raw.camera.bf / frame.depth_m
        np.testing.assert_array_equal(
            np.isfinite(read), np.isfinite(disparity) & (disparity > 1 / 256)
        )
        known = np.isfinite(read)
        assert known.mean() > 0.5
        error_px = np.abs(read - disparity)[known]
        assert 1e-6 < error_px.max() < 1 / 256
        if k > 0:
            flow = dis.compute(*(to_gray(f.image) for f in frames[k - 1 : k + 1]))
            np.testing.assert_array_equal(frame.flow_prev_to_curr_px, flow)
        expected = Detector().detect(frames[k])
        np.testing.assert_array_equal(frame.instance_labels, expected.labels)
        assert frame.instance_classes == {3: "car", 300: "person"}
    scores = json.loads((stereo_folder / "masks/0.json").read_text())
    assert scores["3"] == {"class": "car", "score": 0.75}


def test_a_second_call_does_no_work(stereo_folder: Path) -> None:
    prepare(open_sequence(stereo_folder), FAST, detector=Detector())
    before, detector = times_of(stereo_folder), Detector()
    done = prepare(open_sequence(stereo_folder), FAST, detector=detector)
    assert done.made == {"depth": 0, "flow": 0, "masks": 0}
    assert done.kept == {"depth": N, "flow": N - 1, "masks": N}
    assert detector.seen == []
    assert times_of(stereo_folder) == before


def test_an_interrupted_call_goes_on_where_it_stopped(stereo_folder: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        prepare(open_sequence(stereo_folder), FAST, detector=Detector(stop_after=2))
    half = times_of(stereo_folder)
    assert {"masks/1.png", "flow/1.flo", "depth/2.png"} <= set(half)
    assert "masks/2.png" not in half
    # Half-way the folder can be used: a frame without depth has its right image.
    frames = [open_sequence(stereo_folder).read(k) for k in (2, 3)]
    assert [f.depth_m is not None for f in frames] == [True, False]
    assert [f.image_right is not None for f in frames] == [False, True]
    detector = Detector()
    done = prepare(open_sequence(stereo_folder), FAST, detector=detector)
    assert detector.seen == [2, 3]
    assert done.kept["masks"] == 2
    after = times_of(stereo_folder)
    assert {name: after[name] for name in half if "/" in name} == {
        name: time for name, time in half.items() if "/" in name
    }
    assert not list(stereo_folder.rglob(".*"))


def test_damaged_files_are_made_anew(stereo_folder: Path) -> None:
    prepare(open_sequence(stereo_folder), FAST, detector=Detector())
    for name in ("depth/1.png", "flow/1.flo", "masks/1.png"):
        path = stereo_folder / name
        path.write_bytes(path.read_bytes()[:30])
    done = prepare(open_sequence(stereo_folder), FAST, detector=Detector())
    assert done.made == {"depth": 1, "flow": 1, "masks": 1}
    assert open_sequence(stereo_folder).read(1).depth_m is not None


def test_other_settings_never_mix(stereo_folder: Path) -> None:
    flow = {"what": ["flow"]}
    prepare(open_sequence(stereo_folder), FAST, frames=3, **flow)
    fine = load_config(overrides=["flow.preset=medium"])
    with pytest.raises(ConfigError, match=r"preset: ultrafast, now medium.*--overwrite"):
        prepare(open_sequence(stereo_folder), fine, **flow)
    done = prepare(open_sequence(stereo_folder), fine, overwrite=True, **flow)
    assert done.made == {"flow": N - 1}
    raw = open_sequence(stereo_folder, prepared=False)
    expected = DisFlow("medium").compute(*(to_gray(raw.read(k).image) for k in (0, 1)))
    read = open_sequence(stereo_folder).read(1)
    np.testing.assert_array_equal(read.flow_prev_to_curr_px, expected)
    assert read.depth_m is None
    assert read.image_right is not None


def test_frames_limit_and_extend(stereo_folder: Path) -> None:
    first = prepare(open_sequence(stereo_folder), FAST, what=["flow"], frames=2)
    assert first.made == {"flow": 1}
    rest = prepare(open_sequence(stereo_folder), FAST, what=["flow"])
    assert (rest.made, rest.kept) == ({"flow": N - 2}, {"flow": 1})


def test_the_users_own_files_are_left_alone(stereo_folder: Path) -> None:
    (stereo_folder / "flow").mkdir()
    frame = open_sequence(stereo_folder).read(0)
    own = np.full((*frame.image.shape[:2], 2), 1.5, np.float32)
    for k in range(N - 1):
        np.save(stereo_folder / f"flow/{k}.npy", own)
    before = times_of(stereo_folder)
    done = prepare(open_sequence(stereo_folder), FAST, what=["depth", "flow"], overwrite=True)
    assert done.left_out == {"flow": "comes with the data"}
    assert done.made == {"depth": N}
    after = times_of(stereo_folder)
    assert all(after[name] == before[name] for name in before if name != "camera.yaml")
    assert open_sequence(stereo_folder).read(1).flow_prev_to_curr_px[0, 0, 0] == 1.5


def test_an_unreadable_frame_costs_its_own_files(
    stereo_folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (stereo_folder / "images/2.png").write_bytes(b"torn")
    done = prepare(open_sequence(stereo_folder), FAST, detector=Detector())
    assert done.made == {"depth": 3, "flow": 1, "masks": 3}
    assert done.skipped == 1
    assert "frame 2 is left out" in caplog.text


def test_another_layout_becomes_a_folder(kitti_folder: Path, tmp_path: Path) -> None:
    source, target = open_sequence(kitti_folder), tmp_path / "new"
    before = times_of(kitti_folder)
    done = prepare(source, FAST, target, frames=3, detector=Detector())
    assert done.made == {"depth": 3, "flow": 2, "masks": 3}
    done = prepare(source, FAST, target, detector=Detector())
    assert done.made == {"depth": 3, "flow": 3, "masks": 3}
    assert times_of(kitti_folder) == before
    prepared = open_sequence(target)
    assert (prepared.dataset, len(prepared), prepared.camera) == ("folder", 6, source.camera)
    np.testing.assert_array_equal(prepared.timestamps_s, source.timestamps_s)
    np.testing.assert_array_equal(prepared.read(3).image, source.read(3).image)
    assert prepared.read(3).depth_m is not None
    image = kitti_folder / "image_2/000003.png"
    assert (target / "images/000003.png").samefile(image)  # no second copy on the disk
    truths = [sequence.ground_truth() for sequence in (source, prepared)]
    np.testing.assert_allclose(truths[0].Ts_world_camera, truths[1].Ts_world_camera, atol=1e-8)


def test_depth_that_comes_along_keeps_its_coding(tum_folder: Path, tmp_path: Path) -> None:
    source = open_sequence(tum_folder)
    done = prepare(source, FAST, tmp_path / "new", what=["flow"])
    assert done.made == {"depth": 6, "flow": 5}  # without depth it could not be opened
    prepared = open_sequence(tmp_path / "new")
    assert prepared.camera.is_rgbd
    for k in (0, 5):
        np.testing.assert_array_equal(prepared.read(k).depth_m, source.read(k).depth_m)


def test_given_inputs_of_another_layout_are_taken_along(vdo_folder: Path, tmp_path: Path) -> None:
    source = open_sequence(vdo_folder)
    done = prepare(source, FAST, tmp_path / "new")
    assert done.made == {"depth": 10, "flow": 9, "masks": 10}
    prepared = open_sequence(tmp_path / "new")
    for k in (0, 9):
        one, other = source.read(k), prepared.read(k)
        for part in ("image", "depth_m", "flow_prev_to_curr_px", "instance_labels"):
            np.testing.assert_array_equal(getattr(one, part), getattr(other, part))


def test_a_sequence_that_is_no_files(street, tmp_path: Path) -> None:
    done = prepare(street, FAST, tmp_path / "new", frames=2)
    assert done.made == {"depth": 2, "flow": 1, "masks": 2}
    prepared = open_sequence(tmp_path / "new")
    one, other = street.read(1), prepared.read(1)
    for part in ("image", "depth_m", "flow_prev_to_curr_px", "instance_labels"):
        np.testing.assert_array_equal(getattr(one, part), getattr(other, part))


def test_a_folder_of_something_else_is_not_filled(
    kitti_folder: Path, stereo_folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other/letter.txt").write_text("mine")
    with pytest.raises(DatasetError, match="expected an empty folder, or one that prepare began"):
        prepare(open_sequence(kitti_folder), FAST, tmp_path / "other")
    prepare(open_sequence(kitti_folder), FAST, tmp_path / "new", what=[], frames=1)
    with pytest.raises(DatasetError, match="expected a folder prepared from drive"):
        prepare(open_sequence(stereo_folder), FAST, tmp_path / "new", what=[])


def test_wishes_that_cannot_be_met(stereo_folder: Path) -> None:
    with pytest.raises(ConfigError, match="expected some of depth, flow, masks, found 'speed'"):
        prepare(open_sequence(stereo_folder), FAST, what=["speed"])
    config = load_config(overrides=["flow.name=files"])
    done = prepare(open_sequence(stereo_folder), config, what=["flow"])
    assert done.left_out == {"flow": "does not come with the data; choose another flow.name"}


def test_the_detector_of_the_settings_is_asked_for_once(stereo_folder: Path, monkeypatch) -> None:
    asked, detector = [], Detector()
    monkeypatch.setattr(
        prepare_steps,
        "_load_detector",
        lambda config, given: (asked.append(given), (detector, "fake"))[1],
    )
    every_third = replace(FAST, detector=replace(FAST.detector, every_n=3))
    prepare(open_sequence(stereo_folder), every_third, what=["masks"])
    assert asked == [False]
    assert detector.seen == [0, 1, 2, 3]  # files are for every frame, whatever a run would skip


def test_wide_disparities_keep_within_16_bits(stereo_folder: Path) -> None:
    config = load_config(overrides=["depth.sgbm_num_disparities=320"])
    prepare(open_sequence(stereo_folder), config, what=["depth"], frames=1)
    assert "disparity_scale: 128.0" in (stereo_folder / "camera.yaml").read_text()
    raw = open_sequence(stereo_folder, prepared=False).read(0)
    expected = StereoDepth(config.depth, open_sequence(stereo_folder).camera).disparity(
        raw.image, raw.image_right
    )
    read = open_sequence(stereo_folder).camera.bf / open_sequence(stereo_folder).read(0).depth_m
    assert np.nanmax(np.abs(read - expected)) < 1 / 128


def test_a_run_uses_what_was_prepared(stereo_folder: Path, tmp_path: Path) -> None:
    from pipelines import run

    prepare(open_sequence(stereo_folder), FAST, what=["depth"])
    shutil.rmtree(stereo_folder / "right")
    result = run(open_sequence(stereo_folder), output=tmp_path / "result")
    assert result.metrics["run"]["tracked"] == N
