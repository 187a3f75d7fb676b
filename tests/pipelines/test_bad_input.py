"""What a user may hand in by mistake: each gives one clear sentence, or a result that says so.

Folders are those of the street, damaged here; files that are only wrong in one layout are tested
beside that layout.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.errors import DatasetError
from pipelines.io.result import Result, load_result
from pipelines.runner import run

ROOT = Path(__file__).resolve().parents[2]


# A shell's background job is started deaf to Ctrl-C, and so would be all that it starts
HEARS_CTRL_C = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from app.__main__ import main; sys.exit(main(sys.argv[1:]))"
)


def start_app(*words: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", HEARS_CTRL_C, *map(str, words)],
        cwd=ROOT,
        env={**os.environ, "DYOB_NO_SETUP": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run_folder(folder: Path) -> Result:
    """A run of a folder into a result beside it."""
    return run(open_sequence(folder), output=folder.parent / "result")


def camera_errors_m(result: Result) -> tuple[float, float]:
    """RPE and ATE, RMSE in metres."""
    camera = result.metrics["camera"]
    return camera["rpe_trans_rmse_m"], camera["ate_rmse_m"]


def warnings_of(caplog: pytest.LogCaptureFixture) -> str:
    return "\n".join(r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING)


def rewrite(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """The image at `path` passed through `change`."""
    assert cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def blacken(image: np.ndarray) -> np.ndarray:
    return np.zeros_like(image)


# ------------------------------------------------------------------- folders


def test_a_missing_folder_is_named(tmp_path) -> None:
    with pytest.raises(DatasetError, match="no such folder") as raised:
        open_sequence(tmp_path / "stret")
    assert str(tmp_path / "stret") in str(raised.value)


def test_an_empty_folder_is_told_what_was_expected(tmp_path) -> None:
    with pytest.raises(DatasetError, match="empty") as raised:
        open_sequence(tmp_path)
    for layout in ("vdo", "kitti_odometry", "tum_rgbd", "folder"):
        assert layout in str(raised.value)


@pytest.mark.parametrize("dataset", ["vdo", "kitti_odometry", "tum_rgbd", "folder"])
def test_an_empty_folder_of_a_named_layout_is_an_error(dataset: str, tmp_path) -> None:
    with pytest.raises(DatasetError, match=rf"as {dataset}: .*[Ff]ound: an empty folder"):
        open_sequence(tmp_path, dataset)


@pytest.mark.parametrize(
    ("fixture", "file"),
    [
        ("vdo_folder", "settings.yaml"),
        ("tum_folder", "camera.yaml"),
        ("kitti_folder", "calib.txt"),
    ],
)
def test_missing_calibration_is_named(fixture: str, file: str, request) -> None:
    folder = request.getfixturevalue(fixture)
    dataset = open_sequence(folder).dataset
    (folder / file).unlink()
    with pytest.raises(DatasetError, match="missing calibration"):
        open_sequence(folder, dataset)


def test_a_calibration_without_its_baseline_names_it(vdo_folder) -> None:
    settings = vdo_folder / "settings.yaml"
    lines = settings.read_text().splitlines(keepends=True)
    settings.write_text("".join(line for line in lines if "bf" not in line))
    with pytest.raises(DatasetError, match=r"missing calibration.*no Camera\.bf"):
        open_sequence(vdo_folder)


def test_bad_input_reaches_a_user_as_one_sentence(tmp_path) -> None:
    with start_app("run", tmp_path / "no-such-folder") as process:
        out, error = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "no such folder" in error
    assert "Traceback" not in out + error


# ------------------------------------------------------------------- frames


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


# -------------------------------------------------------------------- masks


def masks_of(folder: Path) -> list[Path]:
    return sorted((folder / "semantic").iterdir())


def write_folder(street, root: Path, n_frames: int = 6) -> Path:
    """The street in the layout for data of one's own, with masks."""
    camera = street.camera
    for name in ("images", "depth", "masks"):
        (root / name).mkdir(parents=True)
    for k in range(n_frames):
        frame = street.read(k)
        assert cv2.imwrite(str(root / f"images/{k}.png"), frame.image[..., ::-1])
        assert cv2.imwrite(str(root / f"masks/{k}.png"), frame.instance_labels.astype(np.uint16))
        np.save(root / f"depth/{k}.npy", frame.depth_m)
    (root / "camera.yaml").write_text(
        f"fx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\nbf: {camera.bf}\n"
        "fps: 10\n"
    )
    return root


def test_a_mask_of_another_size_is_named_and_its_frame_skipped(street, tmp_path, caplog) -> None:
    """Whoever masks pictures of another size has masked other pictures."""
    folder = write_folder(street, tmp_path / "own")
    rewrite(folder / "masks/3.png", lambda mask: mask[:-10, :-20])
    result = run_folder(folder)
    counts = result.metrics["run"]
    assert (counts["frames"], counts["tracked"], counts["skipped"]) == (6, 5, 1)
    (said,) = [line for line in warnings_of(caplog).splitlines() if "frame 3 skipped" in line]
    assert str(Path("masks/3.png")) in said
    assert "497 x 150" in said
    assert "477 x 140" in said
    assert len(result.objects) > 30
    assert 3 not in result.objects.frame_index


def test_masks_that_are_all_of_another_size_are_one_clear_sentence(street, tmp_path) -> None:
    folder = write_folder(street, tmp_path / "own")
    for mask in (folder / "masks").iterdir():
        rewrite(mask, lambda pixels: pixels[:-10, :-20])
    with pytest.raises(DatasetError, match="expected frames that can be read, found none"):
        run_folder(folder)


def test_masks_of_labels_up_to_65535_are_read_as_they_are(street, tmp_path) -> None:
    plain = run_folder(write_folder(street, tmp_path / "plain" / "own"))
    folder = write_folder(street, tmp_path / "high" / "own")
    for mask in (folder / "masks").iterdir():
        rewrite(mask, lambda labels: np.where(labels > 0, 65335 + labels, 0).astype(np.uint16))
    high = run_folder(folder)
    assert (open_sequence(folder).read(0).instance_labels > 65335).any()
    for name in ("objects.csv", "camera_kitti.txt"):
        assert (high.folder / name).read_bytes() == (plain.folder / name).read_bytes()
    assert len(plain.objects) > 30


def test_masks_that_are_all_black_are_a_street_without_objects(vdo_folder) -> None:
    for mask in masks_of(vdo_folder):
        rewrite(mask, blacken)
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["tracked"] == 10
    assert len(result.objects) == 0
    assert not (result.folder / "objects").exists()
    assert load_result(result.folder).metrics["objects"]["object_frames"] == 0


def test_masks_that_hide_all_are_a_clear_outcome(vdo_folder) -> None:
    for mask in masks_of(vdo_folder):
        rewrite(mask, np.ones_like)
    result = run_folder(vdo_folder)
    counts = result.metrics["run"]
    assert (counts["tracked"], counts["lost"]) == (0, 10)
    assert np.isnan(result.objects.speed_mps).all()


def test_masks_that_are_missing_are_carried_by_flow(vdo_folder, caplog) -> None:
    """The very first among them: it does not decide that there are none."""
    for k in (0, 5):
        (vdo_folder / f"semantic/{k:06d}.png").unlink()
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["tracked"] == 10
    for k in (0, 5):
        assert f"frame {k} has no mask" in warnings_of(caplog)
    objects = result.objects
    assert objects.frame_index.min() == 1
    carried = objects[objects.frame_index == 5]
    seen = carried[np.isfinite(carried.score)]
    assert len(seen) > 3
    assert (seen.score == 0).all()
    assert (seen.speed_mps > 5).any()
    assert result.metrics["objects"]["id_switches_while_moving"] == 0


# --------------------------------------------------------------- black frames


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


def test_the_program_fails_in_words_where_no_frame_could_be_tracked(vdo_folder) -> None:
    for image in (vdo_folder / "image_0").iterdir():
        rewrite(image, blacken)
    output = vdo_folder.parent / "result"
    with start_app("run", vdo_folder, "--output", output, "--quiet") as process:
        out, error = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "no frame could be tracked" in error
    assert "Traceback" not in out + error
    assert json.loads((output / "metrics.json").read_text())["run"]["lost"] == 10


# --------------------------------------------------------------- interruption


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes to stop a run at a frame")
def test_a_signal_leaves_a_valid_partial_result(vdo_folder) -> None:
    """SIGINT while frame 6 is awaited: its depth is a pipe that nothing comes out of."""
    from evo.tools import file_interface

    depth, output = vdo_folder / "depth/000006.png", vdo_folder.parent / "result"
    content = depth.read_bytes()
    depth.unlink()
    os.mkfifo(depth)
    with start_app("run", vdo_folder, "--output", output) as process:
        log, deadline = output / "run.log", time.monotonic() + 120
        while not (log.exists() and "frame 5 OK" in log.read_text()):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline, "did not reach frame 5"
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        time.sleep(0.2)
        with depth.open("wb") as pipe:  # lets the reading thread end
            pipe.write(content)
        out, error = process.communicate(timeout=120)
    assert process.returncode == 130, out + error
    assert "Traceback" not in out + error
    result = load_result(output)
    assert result.metrics["run"]["interrupted"] is True
    assert result.metrics["run"]["frames"] == 6
    assert file_interface.read_tum_trajectory_file(output / "camera_tum.txt").num_poses == 6
    assert len(file_interface.read_kitti_poses_file(output / "camera_kitti.txt").poses_se3) == 6
    assert len(result.static_points_m) > 100
    assert 1e-5 < camera_errors_m(result)[0] < 4e-3
