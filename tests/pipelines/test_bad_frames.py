"""Frames of a folder that are damaged, absent or black: each costs itself, and the result says."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.errors import DatasetError
from pipelines.io.result import load_result
from pipelines.runner import run
from tests.pipelines.damage import blacken, camera_errors_m, rewrite, run_folder, warnings_of


@pytest.mark.parametrize("damage", ["cut short", "empty", "text", "absent"])
def test_an_unreadable_image_is_skipped_and_counted(vdo_folder, caplog, damage: str) -> None:
    image = vdo_folder / "image_0/000004.png"
    content = image.read_bytes()
    damaged = {"cut short": content[: len(content) // 3], "empty": b"", "text": b"no image"}
    if damage == "absent":
        sequence = open_sequence(vdo_folder)  # it was there when the sequence was opened
        image.unlink()
    else:
        image.write_bytes(damaged[damage])
        sequence = open_sequence(vdo_folder)
    result = run(sequence, output=vdo_folder.parent / "result")
    counts = result.metrics["run"]
    assert (counts["frames"], counts["tracked"], counts["skipped"]) == (10, 9, 1)
    assert "frame 4 skipped" in warnings_of(caplog)
    assert "000004.png" in warnings_of(caplog)
    assert "frame 4 skipped" in (result.folder / "run.log").read_text()
    assert result.timings["frames_index"] == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    rpe_m, ate_m = camera_errors_m(result)
    assert 1e-5 < rpe_m < 0.02
    assert 1e-5 < ate_m < 0.08


def test_the_first_image_may_be_the_unreadable_one(vdo_folder) -> None:
    (vdo_folder / "image_0/000000.png").write_bytes(b"")
    counts = run_folder(vdo_folder).metrics["run"]
    assert (counts["tracked"], counts["skipped"]) == (9, 1)


def test_no_readable_image_at_all_is_an_error(vdo_folder) -> None:
    for image in (vdo_folder / "image_0").iterdir():
        image.write_bytes(b"no image")
    sequence = open_sequence(vdo_folder)  # its settings state the size
    with pytest.raises(DatasetError, match=r"expected frames that can be read, found none"):
        run(sequence, output=vdo_folder.parent / "result")


def test_an_image_of_another_size_is_skipped_and_counted(vdo_folder, caplog) -> None:
    rewrite(vdo_folder / "image_0/000004.png", lambda image: image[:-10, :-20])
    result = run_folder(vdo_folder)
    counts = result.metrics["run"]
    assert (counts["frames"], counts["tracked"], counts["skipped"]) == (10, 9, 1)
    assert "497 x 150" in warnings_of(caplog)
    assert "477 x 140" in warnings_of(caplog)
    assert 1e-5 < camera_errors_m(result)[0] < 0.02


def test_images_of_another_size_than_the_settings_are_an_error(vdo_folder) -> None:
    for image in (vdo_folder / "image_0").iterdir():
        rewrite(image, lambda pixels: pixels[:-10, :-20])
    with pytest.raises(DatasetError, match=r"497 x 150.*477 x 140"):
        open_sequence(vdo_folder)


def test_a_frame_without_its_depth_file_is_tracked(vdo_folder, caplog) -> None:
    (vdo_folder / "depth/000005.png").unlink()
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["tracked"] == 10
    assert "frame 5 has no depth" in warnings_of(caplog)
    rpe_m, ate_m = camera_errors_m(result)
    assert 1e-5 < rpe_m < 4e-3
    assert 1e-5 < ate_m < 6e-3


def test_a_pair_without_its_right_image_is_tracked(kitti_folder, caplog) -> None:
    (kitti_folder / "image_3/000003.png").unlink()
    result = run_folder(kitti_folder)
    assert result.metrics["run"]["tracked"] == 6
    assert "frame 3 has no right image" in warnings_of(caplog)
    assert 1e-5 < camera_errors_m(result)[0] < 0.03


def test_a_frame_of_unknown_depth_is_tracked(vdo_folder) -> None:
    """Zeros on disk are NaN in memory: nothing was measured."""
    rewrite(vdo_folder / "depth/000005.png", blacken)
    assert np.isnan(open_sequence(vdo_folder).read(5).depth_m).all()
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["tracked"] == 10
    assert 1e-5 < camera_errors_m(result)[0] < 4e-3


def test_scattered_nan_in_depth_arrays_is_survived(street, tmp_path) -> None:
    """A folder of metric .npy arrays whose every frame is NaN at random in three pixels of ten."""
    folder = tmp_path / "arrays"
    (folder / "images").mkdir(parents=True)
    (folder / "depth").mkdir()
    camera, rng = street.camera, np.random.default_rng(0)
    for k in range(6):
        frame = street.read(k)
        assert cv2.imwrite(str(folder / f"images/{k}.png"), frame.image[..., ::-1])
        depth = frame.depth_m.copy()
        depth[rng.random(depth.shape) < 0.3] = np.nan
        np.save(folder / f"depth/{k}.npy", depth)
    (folder / "camera.yaml").write_text(
        f"fx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\nbf: {camera.bf}\n"
        "fps: 10\n"
    )
    result = run_folder(folder)
    assert result.metrics["run"]["tracked"] == 6
    assert np.isfinite(result.Ts_world_camera).all()
    assert np.isfinite(result.static_points_m).all()
    true_end_m = street.ground_truth().Ts_world_camera[5][:3, 3]
    error_m = np.linalg.norm(result.Ts_world_camera[5][:3, 3] - true_end_m)
    assert 1e-5 < error_m < 0.15  # after 4 m


def test_depth_of_nan_throughout_is_a_clear_outcome(vdo_folder) -> None:
    for depth in (vdo_folder / "depth").iterdir():
        rewrite(depth, blacken)
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["lost"] == 10
    assert len(result.timestamps_s) == len(result.static_points_m) == 0


def test_damaged_flow_and_masks_cost_their_frame_alone(vdo_folder, caplog) -> None:
    flow, mask = vdo_folder / "flow/000003.flo", vdo_folder / "semantic/000006.png"
    flow.write_bytes(flow.read_bytes()[:1000])
    mask.write_bytes(b"")
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["tracked"] == 10
    assert "frame 4 goes without flow" in warnings_of(caplog)
    assert "frame 6 goes without mask" in warnings_of(caplog)
    assert 1e-5 < camera_errors_m(result)[0] < 0.03


def test_black_frames_in_the_middle_are_lost_and_tracking_goes_on(vdo_folder) -> None:
    shutil.rmtree(vdo_folder / "flow")  # nobody has flow of the dark
    for k in (4, 5):
        rewrite(vdo_folder / f"image_0/{k:06d}.png", blacken)
    result = run_folder(vdo_folder)
    assert result.timings["frames_status"] == ["OK"] * 4 + ["LOST"] * 2 + ["OK"] * 4
    assert result.metrics["run"]["lost"] == 2
    rpe_m, ate_m = camera_errors_m(result)
    assert 1e-5 < rpe_m < 0.03
    assert 1e-5 < ate_m < 0.1


def test_black_stereo_pairs_in_the_middle_are_lost_and_tracking_goes_on(kitti_folder) -> None:
    for name in ("image_2", "image_3"):
        rewrite(kitti_folder / f"{name}/000003.png", blacken)
    result = run_folder(kitti_folder)
    assert result.timings["frames_status"] == ["OK"] * 3 + ["LOST"] + ["OK"] * 2
    assert camera_errors_m(result)[1] < 0.1


def test_a_sequence_of_black_frames_is_a_clear_outcome(vdo_folder) -> None:
    for image in (vdo_folder / "image_0").iterdir():
        rewrite(image, blacken)
    result = run_folder(vdo_folder)
    counts = result.metrics["run"]
    assert (counts["frames"], counts["tracked"], counts["lost"]) == (10, 0, 10)
    assert counts["map_points"] == counts["keyframes"] == 0
    again = load_result(result.folder)
    assert len(again.timestamps_s) == len(again.static_points_m) == 0
    assert again.metrics["camera"]["frames_matched"] == 0
    assert again.metrics["camera"]["ate_rmse_m"] is None
