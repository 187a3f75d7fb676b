"""Videos of a run: their size, times and pictures re-read by others, and a browser that plays."""

from __future__ import annotations

import shutil
from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from pipelines.errors import DyObError
from pipelines.io.result import Result
from viz import style
from viz.mp4 import open_mp4
from viz.video import durations_s, write_video


def decode(path) -> tuple[np.ndarray, np.ndarray]:
    """Pictures (N, H, W, 3) RGB and times (N,)."""
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        return (
            np.array([frame.to_ndarray(format="rgb24") for frame in frames]),
            np.array([frame.time for frame in frames]),
        )


def test_frames_above_and_map_below(short_run, tmp_path):
    path = write_video(short_run, tmp_path / "run.mp4", width=320)
    reader = cv2.VideoCapture(str(path))
    assert int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) == 8
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
    pictures, times = decode(path)
    np.testing.assert_allclose(times, np.arange(8) * 0.1, atol=1e-3)
    H, W = pictures.shape[1:3]
    frame_px = round(64 / 201 * 320 / 2) * 2
    assert W == 320 and H % 2 == 0 and frame_px + 100 < H
    for k, picture in enumerate(pictures):
        np.testing.assert_allclose(picture[20, 160], [0, 30 * k, 200], atol=6)
        below = picture[frame_px + 2 :].astype(int)
        assert (below > 250).all(2).mean() > 0.4  # white stays white
        for color in (style.object_color(3), style.ESTIMATE):
            assert (np.abs(below - color).sum(2) < 90).any()
    assert path.read_bytes().index(b"moov") < path.read_bytes().index(b"mdat")  # plays at once


def test_halves_of_before_and_after_the_batch_say_so(short_run, tmp_path):
    """In words at the map's top left, where else nothing is; not where both are the same."""
    pictures = {}
    for is_optimised in (False, True):
        run = replace(short_run, metrics={"batch": {"accepted": is_optimised}})
        pictures[is_optimised], _ = decode(write_video(run, tmp_path / "run.mp4", width=640))
    differs = np.abs(pictures[True].astype(int) - pictures[False]).max(3) > 60
    frame_px = round(64 / 201 * 640 / 2) * 2
    for k in range(8):
        v, u = np.nonzero(differs[k])
        assert len(v) > 100 and v.min() >= frame_px and v.max() < frame_px + 60 and u.min() < 60


def test_without_annotated_frames_the_map_fills_the_video(short_run, tmp_path, caplog):
    shutil.rmtree(tmp_path / "frames")
    pictures, _ = decode(write_video(short_run, tmp_path / "run.mp4", width=320))
    assert pictures.shape[1:] == (180, 320, 3)
    assert "no annotated frames" in caplog.text
    assert (pictures > 250).all(3).mean() > 0.4


def test_a_missing_frame_keeps_the_one_before(short_run, tmp_path, caplog):
    (tmp_path / "frames" / "000004.png").unlink()
    pictures, _ = decode(write_video(short_run, tmp_path / "run.mp4", width=320))
    np.testing.assert_allclose(pictures[4, 20, 160], [0, 90, 200], atol=6)
    assert "1 of 8 annotated frames are missing" in caplog.text


def lost(result: Result, frames: list[int]) -> Result:
    keep = ~np.isin(np.arange(len(result.timestamps_s)), frames)
    return replace(
        result,
        timestamps_s=result.timestamps_s[keep],
        Ts_world_camera=result.Ts_world_camera[keep],
    )


@pytest.mark.parametrize("case", ["one frame", "no objects", "lost", "all lost", "no points"])
@pytest.mark.parametrize("view", ["chase", "top", "iso"])
def test_thin_runs_have_videos(short_run, tmp_path, case, view):
    if case == "one frame":
        timings = {"frames_index": [0], "frames_timestamp_s": [0.0]}
        run = replace(lost(short_run, list(range(1, 8))), timings=timings)
    elif case == "no objects":
        run = replace(short_run, objects=short_run.objects[:0])
    elif case == "no points":
        none = np.empty((0, 3))
        run = replace(short_run, static_points_m=none, static_colors=none.astype(np.uint8))
    else:
        run = lost(short_run, [0, 3, 4] if case == "lost" else list(range(8)))
    pictures, times = decode(write_video(run, tmp_path / "run.mp4", width=320, view=view))
    assert len(pictures) == len(times) == (1 if case == "one frame" else 8)


def test_uneven_times_are_kept_and_long_gaps_shortened(short_run, tmp_path):
    stamps = np.array([0.0, 0.1, 0.15, 0.45, 0.55, 60.0, 60.1, 60.2])
    timings = {"frames_index": list(range(8)), "frames_timestamp_s": stamps.tolist()}
    run = replace(short_run, timestamps_s=stamps, timings=timings)
    _, times = decode(write_video(run, tmp_path / "run.mp4", width=320, view="top"))
    expected = [0.0, 0.1, 0.15, 0.45, 0.55, 2.55, 2.65, 2.75]
    np.testing.assert_allclose(times, expected, atol=1e-3)
    assert durations_s(np.array([5.0])).tolist() == [1.0]
    np.testing.assert_allclose(durations_s(np.array([0.0, 0.1, 0.1, 0.2])), 0.1)


def test_what_cannot_be_made_is_said(short_run, tmp_path):
    empty = replace(lost(short_run, list(range(8))), timings={})
    with pytest.raises(DyObError, match="expected frames to make a video of"):
        write_video(empty, tmp_path / "run.mp4")
    with pytest.raises(DyObError, match="expected to write this"):
        write_video(short_run, tmp_path / "gone" / "run.mp4", width=320)
    with pytest.raises(ValueError, match="side"):
        write_video(short_run, tmp_path / "run.mp4", view="side")
    with (
        pytest.raises(ValueError, match="even sides"),
        open_mp4(tmp_path / "odd.mp4", (33, 32), np.ones(1)),
    ):
        pass
    assert not list(tmp_path.glob("*.mp4"))


@pytest.mark.slow
def test_a_browser_plays_it(short_run, tmp_path, browser):
    write_video(short_run, tmp_path / "run.mp4", width=320)
    page_file = tmp_path / "page.html"
    page_file.write_text("<video src='run.mp4' muted loop></video>")
    context = browser.new_context()
    page = context.new_page()
    page.goto(page_file.as_uri())
    page.evaluate("document.querySelector('video').play()")
    page.wait_for_function("document.querySelector('video').currentTime > 0.2")
    state = page.evaluate(
        "(v => [v.readyState, v.videoWidth, v.duration, v.error])(document.querySelector('video'))"
    )
    context.close()
    assert state[0] >= 2 and state[1] == 320 and state[3] is None
    assert state[2] == pytest.approx(0.8, abs=0.02)
