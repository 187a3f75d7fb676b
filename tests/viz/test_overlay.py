"""Annotated frames: every mark at its pixel in its colour, and the sink that writes them."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipelines.errors import DyObError
from pipelines.types import Frame, FrameResult, MotionHypothesis, TrackingStatus
from viz import style
from viz.overlay import FrameWriter, draw_frame, write_image

POINTS = np.array([[100.0, 120.0], [200.0, 120.0], [300.0, 120.0]])  # inlier, outlier, untracked


def make_frame(index: int = 0, *, grey: bool = False, labels: bool = False) -> Frame:
    shape = (240, 400) if grey else (240, 400, 3)
    masks = np.zeros((240, 400), np.int32)
    masks[160:220, 40:140] = 3
    return Frame(
        index,
        0.1 * index,
        np.full(shape, 90, np.uint8),
        depth_m=np.ones((240, 400), np.float32),
        instance_labels=masks if labels else None,
    )


def make_result(index: int = 0, status: TrackingStatus = TrackingStatus.OK) -> FrameResult:
    return FrameResult(
        frame_index=index,
        timestamp_s=0.1 * index,
        status=status,
        T_world_camera=np.eye(4),
        pose_covariance=np.eye(6),
        hypothesis=MotionHypothesis.PNP_RANSAC,
        is_keyframe=True,
        keypoints_px=POINTS,
        point_ids=np.array([4, 5, -1]),
        inliers=np.array([True, False, False]),
        reprojection_rmse_px=0.4,
        timings_ms={"total": 21.0},
    )


def near(picture: np.ndarray, point: np.ndarray, color: style.Color, radius: int = 6) -> int:
    """How many pixels about `point` are close to `color`."""
    u, v = point.astype(int)
    patch = picture[v - radius : v + radius + 1, u - radius : u + radius + 1].astype(int)
    return int((np.abs(patch - color).sum(2) < 90).sum())


@pytest.mark.parametrize("grey", [False, True])
def test_marks_are_at_their_points(grey):
    frame, result = make_frame(grey=grey), make_result()
    picture = draw_frame(frame, result)
    assert picture.shape == (240, 400, 3)
    assert picture.dtype == np.uint8
    colors = (style.INLIER, style.OUTLIER, style.UNTRACKED)
    for point, own in zip(POINTS, colors, strict=True):
        for color in colors:
            found = near(picture, point, color)
            assert found >= 3 if color == own else found == 0, (point, color)
    assert (picture[130:, :, :] == 90).all()  # nothing is drawn where nothing was found
    assert frame.image.min() == frame.image.max() == 90  # the frame itself is left alone


def test_masks_take_the_color_of_their_label():
    picture = draw_frame(make_frame(labels=True), make_result())
    color = np.array(style.object_color(3))
    inside = picture[190, 90].astype(float)
    np.testing.assert_allclose(inside, 90 + 0.46 * (color - 90), atol=1.5)
    np.testing.assert_array_equal(picture[190, 40], color)  # contour
    assert (picture[190, 150:] == 90).all()


def test_status_strip_tells_ok_from_lost():
    ok = draw_frame(make_frame(), make_result())
    lost = draw_frame(make_frame(), make_result(status=TrackingStatus.LOST))
    assert tuple(ok[2, 2]) == style.STATUS_OK
    assert tuple(lost[2, 2]) == style.STATUS_LOST
    assert (ok[:15, 60:] > 200).any()  # light letters on the dark strip


@pytest.mark.parametrize("shape", [(48, 64, 3), (20, 20)])
def test_small_images_and_no_points(shape):
    frame = Frame(0, 0.0, np.full(shape, 90, np.uint8))
    none = replace(
        make_result(),
        keypoints_px=np.empty((0, 2)),
        point_ids=np.empty(0, np.int64),
        inliers=np.empty(0, bool),
    )
    assert draw_frame(frame, none).shape == (*shape[:2], 3)
    assert draw_frame(frame, make_result()).shape == (*shape[:2], 3)  # points outside the image


def test_writer_writes_every_nth(tmp_path):
    writer = FrameWriter(every=2)
    writer.start(None, 50, None, tmp_path)
    for k in range(50):
        writer.frame(make_frame(k), make_result(k))
    writer.finish()
    files = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert files == [f"{k:06d}.jpg" for k in range(0, 50, 2)]
    read = cv2.imread(str(tmp_path / "frames" / "000010.jpg"))[..., ::-1].astype(float)
    drawn = draw_frame(make_frame(10), make_result(10))
    assert np.abs(read - drawn).mean() < 0.5
    assert np.abs(read - drawn).max() < 60  # of thin marks; with halved colours it is more


def test_every_nth_is_counted_among_the_frames_of_the_run(tmp_path):
    writer = FrameWriter(every=2)
    writer.start(None, 4, None, tmp_path)
    for k in (1, 4, 7, 10):  # as --start 1 --stride 3 takes them
        writer.frame(make_frame(k), make_result(k))
    writer.finish()
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == [
        "000001.jpg",
        "000007.jpg",
    ]


def test_a_disk_that_refuses_ends_the_pictures_not_the_run(tmp_path, caplog):
    writer = FrameWriter()
    writer.start(None, 5, None, tmp_path)
    (tmp_path / "frames").rmdir()
    for k in range(200):
        writer.frame(make_frame(k), make_result(k))
    writer.finish()
    assert caplog.text.count("no more annotated frames") == 1


def test_finish_without_start(tmp_path):
    FrameWriter().finish()
    assert not (tmp_path / "frames").exists()


def test_unknown_picture_format(tmp_path):
    with pytest.raises(DyObError, match=r"expected \.png or \.jpg"):
        write_image(tmp_path / "a.nonsense", np.zeros((4, 4, 3), np.uint8))


def test_a_lost_wake_up_call_does_not_hang_the_end(tmp_path, monkeypatch) -> None:
    """As when Ctrl-C falls into the queue's `put`: the item is there, and nobody is told."""
    writer = FrameWriter()
    writer.start(None, 1, None, tmp_path)
    put, lost = writer._queue.put, []

    def put_quietly(item, block=True, timeout=None):
        if not lost:
            lost.append(item)
            writer._queue.queue.append(item)
        else:
            put(item, block, timeout)

    time.sleep(0.1)  # the thread waits by now
    monkeypatch.setattr(writer._queue, "put", put_quietly)
    writer.finish()
    assert lost == [None]
