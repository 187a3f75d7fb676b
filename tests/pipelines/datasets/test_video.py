"""Video files: where their depth comes from, which frame is which, and what a lone camera lacks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import matching_datasets, open_sequence
from pipelines.datasets.video import VideoSequence
from pipelines.datasets.video_reader import SEEK_FROM, VideoReader
from pipelines.errors import DatasetError, FrameError

N, WIDTH, HEIGHT = 12, 64, 48
YAML = "fx: 50\nfy: 51\ncx: 31\ncy: 23\n"
STEREO_YAML = YAML + "baseline_m: 0.5\n"


def view(k: int, right: bool = False) -> np.ndarray:
    """(H, W, 3) BGR: its brightness tells the frame, its blue corner the right camera."""
    image = np.full((HEIGHT, WIDTH, 3), 20 + 15 * k, np.uint8)
    image[:16, :16] = (255, 0, 0) if right else (0, 0, 255)
    return image


def frame_number(image: np.ndarray) -> int:
    return round((float(image[20:, 20:].mean()) - 20) / 15)


def is_right(image: np.ndarray) -> bool:
    red, _, blue = image[4:12, 4:12].reshape(-1, 3).mean(0)  # RGB
    assert abs(red - blue) > 100
    return bool(blue > red)


def write_video(path: Path, images: list[np.ndarray], fps: float = 20.0) -> Path:
    code = {".avi": "MJPG", ".mp4": "mp4v", ".mkv": "FFV1"}[path.suffix]
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), fps, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()
    return path


def write_shared(path: Path, axis: int) -> Path:
    return write_video(path, [np.concatenate([view(k), view(k, True)], axis) for k in range(N)])


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv"])
def test_both_images_side_by_side(tmp_path: Path, suffix: str) -> None:
    path = write_shared(tmp_path / f"drive{suffix}", 1)
    (tmp_path / "camera.yaml").write_text(STEREO_YAML + "stereo: left_right\n")
    for given in (path, tmp_path):
        assert matching_datasets(given) == ["video"]
        sequence = open_sequence(given)
        assert (sequence.dataset, sequence.name, len(sequence)) == ("video", "drive", N)
        assert sequence.camera.bf == pytest.approx(25.0)
        assert not sequence.camera.is_rgbd
        np.testing.assert_allclose(sequence.timestamps_s, np.arange(N) / 20)
        for k in range(N):
            frame = sequence.read(k)
            assert frame.image_right is not None
            assert frame.image.shape == frame.image_right.shape == (HEIGHT, WIDTH, 3)
            assert frame_number(frame.image) == frame_number(frame.image_right) == k
            assert (is_right(frame.image), is_right(frame.image_right)) == (False, True)
            assert (frame.index, frame.timestamp_s) == (k, sequence.timestamps_s[k])
        assert sequence.ground_truth() is None
    for outside in (-1, N):
        with pytest.raises(IndexError):
            sequence.read(outside)


def test_one_above_the_other_by_the_size_of_the_yaml(tmp_path: Path) -> None:
    path = write_shared(tmp_path / "drive.mp4", 0)
    (tmp_path / "drive.yaml").write_text(STEREO_YAML + f"width: {WIDTH}\nheight: {HEIGHT}\n")
    frame = open_sequence(path).read(7)
    assert frame.image_right is not None
    assert (frame_number(frame.image), is_right(frame.image)) == (7, False)
    assert is_right(frame.image_right)


def test_two_videos(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_video(tmp_path / "cam_left.mp4", [view(k) for k in range(N)])
    write_video(tmp_path / "cam_right.mp4", [view(k, True) for k in range(N - 2)])
    (tmp_path / "camera.yaml").write_text(STEREO_YAML)
    sequence = open_sequence(tmp_path)
    assert (sequence.name, len(sequence)) == ("cam_left", N - 2)
    assert "12 and 10 frames" in caplog.text
    frame = sequence.read(9)
    assert frame.image_right is not None
    assert (frame_number(frame.image), frame_number(frame.image_right)) == (9, 9)
    assert is_right(frame.image_right)
    write_video(tmp_path / "small.mp4", [np.zeros((24, 32, 3), np.uint8)] * 3)
    with pytest.raises(DatasetError, match=r"small\.mp4: expected images of 64 x 48"):
        open_sequence(tmp_path / "cam_left.mp4", right=tmp_path / "small.mp4")


def write_depths(folder: Path) -> None:
    folder.mkdir()
    for k in range(N):
        depth = np.full((HEIGHT, WIDTH), 1000 + 100 * k, np.uint16)
        assert cv2.imwrite(str(folder / f"{k}.png"), depth)


def test_colour_with_depth_beside_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_video(tmp_path / "room.mp4", [view(k) for k in range(N)])
    write_depths(tmp_path / "depth")
    (tmp_path / "camera.yaml").write_text(YAML + "depth_scale: 1000\n")
    (tmp_path / "depth/3.png").write_bytes(b"damaged")
    sequence = open_sequence(path)
    assert sequence.camera.is_rgbd
    frame = sequence.read(10)
    assert frame.image_right is None
    assert frame.depth_m is not None
    assert frame.depth_m[5, 5] == pytest.approx(2.0)
    assert sequence.read(3).depth_m is None
    assert "frame 3 goes without depth" in caplog.text


def test_times_and_their_options(tmp_path: Path) -> None:
    path = write_shared(tmp_path / "drive.mp4", 1)
    (tmp_path / "camera.yaml").write_text(STEREO_YAML + "stereo: left_right\n")
    late = open_sequence(path, fps=10.0, start_s=5.0)
    np.testing.assert_allclose(late.timestamps_s, 5.0 + np.arange(N) / 10)
    np.savetxt(tmp_path / "times.txt", 0.051 * np.arange(N))
    np.testing.assert_allclose(open_sequence(path).timestamps_s, 0.051 * np.arange(N))
    with pytest.raises(DatasetError, match="unknown option 'fp', did you mean 'fps'"):
        open_sequence(path, fp=3.0)


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        (STEREO_YAML, "one camera alone"),
        (YAML + "stereo: left_right\n", r"expected bf \(px \* m\) or baseline_m"),
        (STEREO_YAML + "stereo: sideways\n", "expected stereo to be left_right or top_bottom"),
        (STEREO_YAML + "stereo: left_right\nwidth: 99\nheight: 48\n", "of 99 x 48 pixels as it"),
        ("fx: 50\nbf: 25\nstereo: left_right\n", "missing calibration, expected fx, fy, cx, cy"),
        (STEREO_YAML + "sterio: left_right\n", "did you mean `stereo`"),
    ],
)
def test_what_a_yaml_may_lack(tmp_path: Path, yaml: str, message: str) -> None:
    path = write_shared(tmp_path / "drive.mp4", 1)
    (tmp_path / "camera.yaml").write_text(yaml)
    with pytest.raises(DatasetError, match=message):
        open_sequence(path)


def test_no_yaml_at_all_shows_one(tmp_path: Path) -> None:
    path = write_shared(tmp_path / "drive.mp4", 1)
    with pytest.raises(
        DatasetError, match=r"missing calibration\. Add beside it camera\.yaml with"
    ):
        open_sequence(path, stereo="left_right")


def test_several_videos_are_not_guessed(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        write_shared(tmp_path / name, 1)
    (tmp_path / "camera.yaml").write_text(STEREO_YAML + "stereo: left_right\n")
    with pytest.raises(DatasetError, match=r"a folder with one, found a\.mp4, b\.mp4; give"):
        open_sequence(tmp_path)
    assert open_sequence(tmp_path / "b.mp4").name == "b"


def test_a_video_cut_short_fails_its_last_frames_alone(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", [view(k) for k in range(N)])
    reader = VideoReader(path)
    with pytest.raises(FrameError, match=f"expected frame {N}, found the end of the video"):
        reader.read(N)
    assert frame_number(reader.read(4)) == 4  # and reading goes on


def test_a_file_that_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"\0" * 2000)
    with pytest.raises(DatasetError, match="expected a video, found a file of 2000 bytes"):
        VideoSequence.open(tmp_path / "a.mp4")
    with pytest.raises(DatasetError, match="found no such folder"):
        VideoSequence.open(tmp_path / "b")


def test_a_frame_read_twice_is_decoded_once(tmp_path: Path, monkeypatch) -> None:
    reader = VideoReader(write_video(tmp_path / "a.mp4", [view(k) for k in range(N)]))
    decoded = []
    grab, read = reader._capture.grab, reader._capture.read

    class Counting:
        def __getattr__(self, name: str):
            return getattr(capture, name)

        def grab(self):
            decoded.append("grab")
            return grab()

        def read(self):
            decoded.append("read")
            return read()

    capture = reader._capture
    reader._capture = Counting()
    for k in (1, 1, 2, 3, 3, 4):
        assert frame_number(reader.read(k)) == k
    assert decoded == ["read"] * 4
    assert frame_number(reader.read(7)) == 7
    assert decoded == ["read"] * 4 + ["grab"] * 2 + ["read"]


def test_jumps_arrive_at_the_frames_of_a_straight_reading(real_data) -> None:
    path = real_data("carnd_solidWhiteRight_mp4") / "solidWhiteRight.mp4"
    straight = VideoReader(path)
    wanted = (3, 60, 150, 220)
    images = {k: straight.read(k).copy() for k in wanted}
    jumping = VideoReader(path)
    for k in (220, 3, 150, 60):
        np.testing.assert_array_equal(jumping.read(k), images[k])
    assert not np.array_equal(images[3], images[60])


def test_far_jumps_use_the_index_of_the_container(tmp_path: Path) -> None:
    images = [np.full((32, 32, 3), 8 * (k % 30), np.uint8) for k in range(SEEK_FROM + 60)]
    reader = VideoReader(write_video(tmp_path / "long.mp4", images))
    for k in (SEEK_FROM + 47, 12, SEEK_FROM + 31):
        assert round(float(reader.read(k).mean()) / 8) == k % 30


def test_a_real_film_of_one_camera_has_no_scale(real_data) -> None:
    path = real_data("carnd_solidWhiteRight_mp4") / "solidWhiteRight.mp4"
    with pytest.raises(DatasetError, match=r"one camera alone \(960 x 540\), which has no scale"):
        open_sequence(path)
