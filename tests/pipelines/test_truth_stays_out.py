"""Ground truth never reaches the estimator: nothing leads to it, and without it no byte changes."""

from __future__ import annotations

import dataclasses
import shutil
from typing import Any

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.runner import run
from pipelines.types import Frame, GroundTruth, ObjectTruth
from tests.pipelines.result_files import estimates, names_in

TRUTH = {
    "vdo": ("pose_gt.txt", "object_pose.txt"),
    "tum_rgbd": ("groundtruth.txt",),
    "kitti_odometry": ("poses.txt",),
}


def test_frames_have_no_room_for_truth() -> None:
    assert {field.name for field in dataclasses.fields(Frame)} == {
        "index",
        "timestamp_s",
        "image",
        "image_right",
        "depth_m",
        "flow_prev_to_curr_px",
        "instance_labels",
        "instance_classes",
    }


def test_nothing_in_the_system_leads_to_truth_or_to_a_sequence(street) -> None:
    slam = DyObSlam(street.camera)
    for k in range(3):
        slam.process(street.read(k))
    seen: dict[int, Any] = {}
    _collect(slam, seen)
    kinds = {type(item).__name__ for item in seen.values()}
    assert {"DyObSlam", "SparseMap", "StereoCamera", "Config"} <= kinds  # the walk went somewhere
    forbidden = (GroundTruth, ObjectTruth, Sequence)
    assert not [item for item in seen.values() if isinstance(item, forbidden)]


def _collect(item: Any, seen: dict[int, Any]) -> None:
    """All objects reachable from `item` by attributes, slots and containers; not array contents."""
    if id(item) in seen or isinstance(item, type | str | bytes | int | float):
        return
    seen[id(item)] = item
    inner: list[Any] = []
    if isinstance(item, dict):
        inner += [*item.keys(), *item.values()]
    elif isinstance(item, list | tuple | set | frozenset):
        inner += list(item)
    inner += list(getattr(item, "__dict__", {}).values())
    for kind in type(item).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        names = [slots] if isinstance(slots, str) else slots
        inner += [getattr(item, name) for name in names if hasattr(item, name)]
    if getattr(item, "__self__", None) is not None and not isinstance(item.__self__, type):
        inner.append(item.__self__)  # of bound methods
    if getattr(item, "__closure__", None):
        inner += [cell.cell_contents for cell in item.__closure__]
    for child in inner:
        if type(child).__name__ != "module":
            _collect(child, seen)


def test_truth_is_opened_after_the_last_frame_alone(street, tmp_path, altered) -> None:
    sequence = altered(street)
    run(sequence, output=tmp_path / "result", frames=4)
    assert sequence.events[:4] == [0, 1, 2, 3]
    assert "truth" in sequence.events[4:]
    assert set(sequence.events[4:]) == {"truth"}


@pytest.mark.parametrize("dataset", list(TRUTH))
def test_deleted_truth_changes_no_byte_of_the_estimate(dataset, request, tmp_path) -> None:
    fixture = {"vdo": "vdo_folder", "tum_rgbd": "tum_folder", "kitti_odometry": "kitti_folder"}
    folder = request.getfixturevalue(fixture[dataset])
    blind = tmp_path / "blind" / folder.name
    shutil.copytree(folder, blind)
    for name in TRUTH[dataset]:
        (blind / name).unlink()
    with_truth = run(open_sequence(folder), output=tmp_path / "with")
    without = run(open_sequence(blind), output=tmp_path / "without")
    assert open_sequence(blind).dataset == dataset
    assert open_sequence(blind).ground_truth() is None
    assert "camera" in with_truth.metrics
    assert "camera" not in without.metrics
    of_truth = names_in(with_truth.folder) - names_in(without.folder)
    assert of_truth == {"camera_gt_tum.txt"} | ({"objects_gt.csv"} if dataset == "vdo" else set())
    assert without.metrics["run"]["tracked"] > 5
    assert estimates(with_truth.folder) == estimates(without.folder)
    if dataset == "vdo":  # its masks make objects at once: bytes of something were compared
        assert len(without.objects) > 50
        assert (without.objects.state == "moving").sum() > 5


def test_false_truth_changes_no_byte_of_the_estimate(vdo_folder, tmp_path) -> None:
    right = run(open_sequence(vdo_folder), output=tmp_path / "right", frames=5)
    rows = np.loadtxt(vdo_folder / "pose_gt.txt")
    rows[:, [4, 8, 12]] *= 3.0  # three times as far
    np.savetxt(vdo_folder / "pose_gt.txt", rows, fmt="%.9f")
    objects = np.loadtxt(vdo_folder / "object_pose.txt")
    objects[:, 2:5] += objects[:, :1]  # every object moves by a metre a frame more
    np.savetxt(vdo_folder / "object_pose.txt", objects, fmt="%.6f")
    false = run(open_sequence(vdo_folder), output=tmp_path / "false", frames=5)
    assert estimates(right.folder) == estimates(false.folder)
    assert false.metrics["camera"]["rpe_trans_rmse_m"] > 1.0  # it was read, and told apart
