"""What every live viewer keeps to: the run and its result are the same as without it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.errors import ConfigError, DyObError
from pipelines.io.config import load_config
from pipelines.runner import KeyframeSink, run
from viz.browser.live_map import LiveFrames
from viz.viewers import VIEWERS, Viewer, load_viewer

N_FRAMES = 8
OF_THE_CLOCK = ("timings.json", "run.log", "metrics.txt")


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Sequence:
    cache = tmp_path_factory.mktemp("rendered")
    return open_sequence("simulated:street", frames=N_FRAMES, scale=0.4, cache=cache)


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in OF_THE_CLOCK
    }


@pytest.fixture(scope="module")
def alone(street, tmp_path_factory) -> dict[str, bytes]:
    """The files of a run that nobody watches."""
    folder = tmp_path_factory.mktemp("alone")
    run(street, load_config(None, ["batch.at_end=false"]), folder)
    return files(folder)


@pytest.mark.parametrize("name", VIEWERS)
def test_a_run_that_is_watched_gives_the_same_bytes(name, street, alone, tmp_path):
    announced: list[str] = []
    viewer = load_viewer(name, announce=announced.append)
    run(street, load_config(None, ["batch.at_end=false"]), tmp_path, sinks=[viewer])
    watched = files(tmp_path)
    assert watched.keys() == alone.keys() and len(alone) > 5
    different = [file for file, data in alone.items() if watched[file] != data]
    assert different == []
    assert len(announced) == 1 and announced[0].startswith("http://127.0.0.1:")


@pytest.mark.parametrize("name", VIEWERS)
def test_two_are_at_different_places(name, street, tmp_path):
    announced: list[str] = []
    viewers = [load_viewer(name, announce=announced.append) for _ in range(2)]
    for viewer in viewers:
        viewer.start(street, N_FRAMES, load_config(), tmp_path)
    assert len(set(announced)) == 2
    taken = int(announced[0].rstrip("/").rsplit(":", 1)[1])
    with pytest.raises(DyObError, match=f"port {taken}"):
        load_viewer(name, port=taken).start(street, N_FRAMES, load_config(), tmp_path)
    for viewer in viewers:
        viewer.finish()


@pytest.mark.parametrize("name", VIEWERS)
def test_one_that_was_never_started_ends_in_peace(name):
    viewer: Viewer = load_viewer(name)
    viewer.finish()


@pytest.mark.parametrize("name", VIEWERS)
def test_handing_over_waits_for_nothing_however_slow_the_view(name, street, tmp_path, monkeypatch):
    """Frames come faster than they are drawn: pictures are left out, and the run never waits."""
    from pipelines.dyob_slam import DyObSlam

    slam = DyObSlam(street.camera)
    frames = [street.read(k) for k in range(N_FRAMES)]
    results = [slam.process(frame) for frame in frames]
    slam.close()
    viewer = load_viewer(name)
    viewer.start(street, 40, load_config(), tmp_path)
    for _ in range(8):
        for frame, result in zip(frames, results, strict=True):
            viewer.frame(frame, result)
    assert viewer.n_left_out >= 40 - 10  # with a picture every 10 ms it would be less
    viewer.finish()


class Follower:
    """A sink that follows the back-end's corrections as a viewer does."""

    def __init__(self) -> None:
        self.frames = LiveFrames()
        self.came: list[Any] = []  # where each keyframe was when it came, and None for others

    def start(self, *arguments: Any) -> None:
        pass

    def frame(self, frame: Any, result: Any) -> None:
        self.frames.add(result)
        self.came.append(result.T_world_camera if result.is_keyframe else None)

    def keyframes(self, *poses: Any) -> None:
        self.frames.follow(*poses)

    def finish(self) -> None:
        pass


def test_frames_that_were_shown_follow_the_back_end(street, tmp_path):
    adjusting = ["backend.local_from_keyframe=0", "backend.process=false"]
    settings = ["batch.at_end=false", "mapping.keyframe_max_interval=2", *adjusting]
    follower = Follower()
    assert isinstance(follower, KeyframeSink)
    result = run(street, load_config(None, settings), tmp_path, sinks=[follower])
    now, there = follower.frames.Ts_world_camera, result.Ts_world_camera
    # Between keyframes the files spread what a view moves in steps, so these alone are the same.
    ks = [k for k, T in enumerate(follower.came) if T is not None]
    came = np.array([follower.came[k] for k in ks])
    np.testing.assert_allclose(now[ks], there[ks], atol=1e-8)
    assert np.abs(came - there[ks]).max() > 1e-6


def test_a_wrong_name_is_told_the_right_one():
    with pytest.raises(ConfigError, match="did you mean 'meshcat'"):
        load_viewer("meschcat")
