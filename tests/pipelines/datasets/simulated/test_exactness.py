"""The truth of simulated sequences, checked by geometry that shares no code with the renderer."""

import cv2
import numpy as np
import pytest


def grid(camera):
    return np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))


def backprojected(camera, depth):
    u, v = grid(camera)
    x = (u - camera.cx) / camera.fx * depth
    y = (v - camera.cy) / camera.fy * depth
    return np.stack([x, y, depth, np.ones_like(x)], -1)


def object_poses(truth, frame):
    rows = truth.objects.frame_index == frame
    ids = truth.objects.object_id[rows]
    return dict(zip(ids.tolist(), truth.objects.Ts_world_object[rows], strict=True))


def warped(image, u, v):
    return cv2.remap(
        image.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan, np.nan, np.nan),
    )  # fmt: skip


def test_world_is_the_first_camera(exact):
    truth = exact.ground_truth()
    assert truth.Ts_world_camera[0] == pytest.approx(np.eye(4), abs=1e-12)
    R = truth.Ts_world_camera[:, :3, :3]
    assert R @ R.swapaxes(1, 2) == pytest.approx(np.broadcast_to(np.eye(3), R.shape), abs=1e-9)
    assert np.linalg.norm(np.diff(truth.Ts_world_camera[:, :3, 3], axis=0), axis=1).min() > 1e-3


def test_flow_is_depth_moved_by_the_true_motion(exact):
    check_flow(exact, 1)


def test_flow_before_a_standing_camera_is_the_motion_of_objects(crossing):
    check_flow(crossing, 1)
    flow, still = crossing.read(2).flow_prev_to_curr_px, crossing.read(1).instance_labels == 0
    assert np.abs(flow[still & np.isfinite(flow[..., 0])]).max() < 1e-4


def test_flow_of_replayed_traffic_is_its_motion(replayed):
    check_flow(replayed, 8)


def check_flow(sequence, k):
    """Back-project frame k, move each label by its truth, project: the flow of frame k + 1."""
    camera, truth = sequence.camera, sequence.ground_truth()
    before, after = sequence.read(k), sequence.read(k + 1)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    now, later = object_poses(truth, k), object_poses(truth, k + 1)
    world = backprojected(camera, before.depth_m.astype(float)) @ truth.Ts_world_camera[k].T
    seen_moving = 0
    for label in np.unique(before.instance_labels):
        mine = before.instance_labels == label
        if label:
            H = later[label] @ np.linalg.inv(now[label])
            seen_moving += np.abs(H - np.eye(4)).max() > 1e-3
            world[mine] = world[mine] @ H.T
    p = world @ np.linalg.inv(truth.Ts_world_camera[k + 1]).T
    q = p[..., :3] @ K.T
    expected = q[..., :2] / q[..., 2:] - np.stack(grid(camera), -1)
    known = np.isfinite(before.depth_m) & (q[..., 2] > 0)
    error = np.abs(after.flow_prev_to_curr_px - expected)[known]
    assert seen_moving >= 2
    assert known.mean() > 0.8
    assert error.max() < 1e-3
    assert np.abs(expected[known]).max() > 1.0


def test_flow_of_the_sky_is_the_rotation_alone(street):
    before, after, camera = street.read(1), street.read(2), street.camera
    sky = np.isnan(before.depth_m)
    assert 0.01 < sky.mean() < 0.4
    Ts = street.ground_truth().Ts_world_camera
    R = Ts[2][:3, :3].T @ Ts[1][:3, :3]
    rays = backprojected(camera, np.ones(sky.shape))[..., :3] @ R.T
    expected = np.stack([rays[..., 0], rays[..., 1]], -1) / rays[..., 2:]
    expected = expected * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    expected -= np.stack(grid(camera), -1)
    assert np.abs(after.flow_prev_to_curr_px - expected)[sky].max() < 1e-3
    assert street.read(0).flow_prev_to_curr_px is None


def test_pictures_agree_along_the_flow(exact):
    """The next picture read along the flow looks like this one, but for occlusions."""
    before, after, camera = exact.read(1), exact.read(2), exact.camera
    u, v = grid(camera)
    flow = after.flow_prev_to_curr_px
    there = warped(after.image, u + flow[..., 0], v + flow[..., 1])
    inside = np.isfinite(there).all(-1)
    error = np.abs(there - before.image)[inside].mean(-1)
    unmoved = np.abs(after.image.astype(float) - before.image)[inside].mean(-1)
    assert inside.mean() > 0.7
    assert 0.05 < np.median(error) < 6.0  # not zero: the pictures are sampled, not copied
    assert (error > 30).mean() < 0.06
    assert error.mean() < 0.6 * unmoved.mean()


def test_right_picture_agrees_with_the_disparity(exact):
    frame, camera = exact.read(2), exact.camera
    u, v = grid(camera)
    disparity = np.nan_to_num(camera.bf / frame.depth_m)
    there = warped(frame.image_right, u - disparity, v)
    inside = np.isfinite(there).all(-1)
    error = np.abs(there - frame.image)[inside].mean(-1)
    unmoved = np.abs(frame.image_right.astype(float) - frame.image)[inside].mean(-1)
    assert inside.mean() > 0.7
    assert 0.05 < np.median(error) < 6.0
    assert error.mean() < 0.5 * unmoved.mean()


def test_depth_of_the_road_is_the_plane_under_the_camera(street):
    """The camera rides 1.65 m above a flat road: depth along the lane follows from its height."""
    frame, camera = street.read(0), street.camera
    column, row = round(camera.cx), camera.height - 2
    depth = frame.depth_m[row, column]
    point = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1]) * depth
    assert point[1] == pytest.approx(1.65, abs=0.08)  # bounce, pitch and roll are this small


def test_nothing_below_the_horizon_is_open(exact):
    """No cracks between the pieces: the lower half has depth everywhere, a room all over."""
    for k in range(len(exact)):
        depth = exact.read(k).depth_m
        first = 0 if exact.name == "room" else exact.camera.height // 2 + 6
        assert np.isfinite(depth[first:]).all()
        assert 0.3 < np.nanmin(depth) < 8


def test_boxes_are_those_of_the_labels(exact):
    truth = exact.ground_truth().objects
    seen = 0
    for k in range(len(exact)):
        labels = exact.read(k).instance_labels
        for row in np.flatnonzero(truth.frame_index == k):
            v, u = np.nonzero(labels == truth.object_id[row])
            if len(u) == 0:
                assert np.isnan(truth.boxes_px[row]).all()
            else:
                seen += 1
                assert truth.boxes_px[row].tolist() == [u.min(), v.min(), u.max(), v.max()]
    assert seen >= 4 * len(exact)
    assert np.isin(np.unique(labels), [0, *truth.object_id]).all()


def test_labelled_points_lie_in_their_object_box(exact):
    """Points of a label, in the frame of its pose, are around the origin, none farther than 3 m."""
    truth, frame = exact.ground_truth(), exact.read(3)
    world = backprojected(exact.camera, frame.depth_m.astype(float)) @ truth.Ts_world_camera[3].T
    poses, checked = object_poses(truth, 3), 0
    names = dict(zip(truth.objects.object_id.tolist(), truth.objects.class_name, strict=True))
    half = {"car": (1.05, 1.05, 2.5), "person": (0.5, 1.0, 0.6)}
    for label in np.unique(frame.instance_labels[frame.instance_labels > 0]):
        local = world[frame.instance_labels == label] @ np.linalg.inv(poses[label]).T
        limit = np.array(half.get(str(names[label]), (0.6, 0.6, 0.6)))
        assert (np.abs(local[:, :3]) < limit + 1e-3).all(), names[label]
        checked += 1
    assert checked >= 4


def test_parked_cars_never_move_and_others_do(street):
    truth = street.ground_truth().objects
    for j in np.unique(truth.object_id):
        rows = truth.object_id == j
        path = np.ptp(truth.Ts_world_object[rows][:, :3, 3], axis=0).max()
        if not truth.moving[rows].any():
            assert path == pytest.approx(0, abs=1e-9)
    cars = truth.class_name == "car"
    assert (cars & ~truth.moving).sum() >= 10 * len(street)
    assert {"car", "person"} <= set(truth.class_name[truth.moving])


def test_static_scene_has_no_motion(cache):
    from pipelines.datasets.simulated import SimulatedSequence

    still = SimulatedSequence("static", frames=2, scale=0.2, cache=cache)
    assert not still.ground_truth().objects.moving.any()
    assert (still.read(1).instance_labels > 0).mean() > 0.01


def test_boxes_and_pixel_counts_are_those_of_the_masks(exact):
    truth, labels = exact.ground_truth().objects, exact.read(2).instance_labels
    rows = np.flatnonzero(truth.frame_index == 2)
    seen = [int((labels == j).sum()) for j in truth.object_id[rows]]
    assert max(seen) > 100
    assert truth.n_pixels[rows].tolist() == seen
    np.testing.assert_array_equal(np.isfinite(truth.boxes_px[rows, 0]), np.array(seen) > 0)
