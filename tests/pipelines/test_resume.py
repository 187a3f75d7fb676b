"""Runs that were interrupted go on, and come to the very bytes of a run that was not."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipelines import checkpoint
from pipelines.backend.loop_detection import LoopClosure
from pipelines.backend.pose_graph import build_pose_graph
from pipelines.backend.questions import ClosingQuestion
from pipelines.checkpoint import read_checkpoint
from pipelines.config import Config
from pipelines.datasets import open_sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.errors import FrameError
from pipelines.geometry import exp_se3
from pipelines.io.config import load_config
from pipelines.io.object_graph import GraphDecoder, GraphEncoder
from pipelines.lasting_map import LastingMap
from pipelines.runner import run
from pipelines.types import Frame
from tests.pipelines.interruption import QUICK, Interrupter
from viz.overlay import FrameWriter

ROOT = Path(__file__).resolve().parents[2]
WITH_TIMES = ("run.log", "timings.json", "metrics.txt")  # beside the batch's, in metrics.json


def content(folder: Path) -> dict[str, bytes | dict]:
    """All files of a result that hold no times of day, by name."""
    files: dict[str, bytes | dict] = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name not in WITH_TIMES
    }
    metrics = json.loads(files["metrics.json"])
    metrics.get("batch", {}).pop("time_s", None)
    return files | {"metrics.json": metrics}


def check_same(folder: Path, whole: Path) -> None:
    ours, theirs = content(folder), content(whole)
    assert set(ours) == set(theirs)
    assert [name for name in ours if ours[name] != theirs[name]] == []


def interrupt_and_resume(sequence, config: Config, folder: Path, at: int, **options) -> Path:
    partial = run(sequence, config, folder, sinks=[Interrupter(at)], **options)
    assert partial.metrics["run"]["interrupted"] is True
    assert partial.metrics["run"]["frames"] == at + 1
    assert (folder / "checkpoint" / "state.npz").exists()
    resumed = run(sequence, config, folder, resume=True, **options)
    assert not (folder / "checkpoint").exists()
    assert f"resumed after {at + 1} frames" in (folder / "run.log").read_text()
    return resumed.folder


@pytest.fixture(scope="module")
def quick(short_street, tmp_path_factory) -> Path:
    """A run without a batch; not to be changed by tests."""
    folder = tmp_path_factory.mktemp("whole") / "result"
    return run(short_street, load_config(None, QUICK), folder).folder


# ------------------------------------------------------------------ the bytes


@pytest.mark.parametrize("at", [0, 6, 9])
def test_the_bytes_are_those_of_a_run_that_was_not_interrupted(
    short_street, quick, tmp_path, at
) -> None:
    config = load_config(None, QUICK)
    check_same(interrupt_and_resume(short_street, config, tmp_path / "result", at), quick)


def test_a_run_may_be_interrupted_again_and_again(short_street, quick, tmp_path) -> None:
    config, folder = load_config(None, QUICK), tmp_path / "result"
    run(short_street, config, folder, sinks=[Interrupter(3)])
    for at in (4, 7, 8):
        run(short_street, config, folder, sinks=[Interrupter(at)], resume=True)
    run(short_street, config, folder, resume=True)
    check_same(folder, quick)


def test_the_batch_at_the_end_is_the_same(short_street, tmp_path) -> None:
    config = load_config(None, ["batch.rounds=1", "batch.max_steps=1", "batch.covariances=false"])
    whole = run(short_street, config, tmp_path / "whole").folder
    assert (whole / "front_end").exists()
    check_same(interrupt_and_resume(short_street, config, tmp_path / "result", 6), whole)


def test_a_batch_that_was_stopped_is_done_by_resuming(short_street, tmp_path, monkeypatch) -> None:
    from pipelines import optimisation

    config = load_config(None, ["batch.rounds=1", "batch.max_steps=1", "batch.covariances=false"])
    whole = run(short_street, config, tmp_path / "whole", frames=6).folder

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(optimisation, "optimise_result", stop)
        run(short_street, config, tmp_path / "result", frames=6)
    run(short_street, config, tmp_path / "result", frames=6, resume=True)
    check_same(tmp_path / "result", whole)


def test_answers_of_the_back_end_that_are_awaited_come_as_they_would_have(
    short_street, tmp_path
) -> None:
    settings = ("backend.local_from_keyframe=0", "mapping.keyframe_max_interval=2")
    config = load_config(None, [*QUICK, *settings, "backend.process=false"])
    whole = run(short_street, config, tmp_path / "whole").folder
    awaited = []
    for at in (4, 6):
        folder = tmp_path / f"at_{at}"
        run(short_street, config, folder, sinks=[Interrupter(at)])
        origin = checkpoint.run_origin(
            short_street, config, range(len(short_street)), LastingMap().origin()
        )
        slam = DyObSlam(short_street.camera, config)
        state = read_checkpoint(folder / "checkpoint", origin, slam.fixed_parts())
        awaited.append(state["slam"]["system"]["_backend"]._question is not None)
        check_same(run(short_street, config, folder, resume=True).folder, whole)
    assert any(awaited)


def test_what_moves_by_geometry_alone_is_the_same(short_street, tmp_path, altered) -> None:
    def bare(frame: Frame) -> Frame:
        return dataclasses.replace(frame, instance_labels=None, flow_prev_to_curr_px=None)

    config = load_config(None, [*QUICK, "detector.name=motion"])
    whole = run(altered(short_street, bare), config, tmp_path / "whole").folder
    found = (whole / "objects.csv").read_text().count("\n")
    assert found > 5  # something to remember
    check_same(interrupt_and_resume(altered(short_street, bare), config, tmp_path / "a", 6), whole)


def test_bad_frames_are_the_same(short_street, tmp_path, altered) -> None:
    """Frames that cannot be read, before and after the interruption, and one that is black."""

    def damage(frame: Frame) -> Frame:
        if frame.index in (4, 8):
            raise FrameError("gone")
        if frame.index == 7:
            return dataclasses.replace(frame, image=np.zeros_like(frame.image))
        return frame

    config = load_config(None, [*QUICK, "detector.every_n=3"])
    options = {"start": 2}
    whole = run(altered(short_street, damage), config, tmp_path / "whole", **options)
    assert whole.metrics["run"]["skipped"] == 2
    folder = tmp_path / "result"
    run(altered(short_street, damage), config, folder, sinks=[Interrupter(6)], **options)
    run(altered(short_street, damage), config, folder, resume=True, **options)
    check_same(folder, whole.folder)


def test_a_map_that_is_continued_is_the_same(short_street, tmp_path) -> None:
    """Loaded from and saved to one folder, which the interruption has changed meanwhile."""
    config = load_config(None, QUICK)
    run(
        short_street,
        config,
        tmp_path / "first",
        frames=6,
        lasting_map=LastingMap(save=tmp_path / "a"),
    )
    run(
        short_street,
        config,
        tmp_path / "first",
        frames=6,
        lasting_map=LastingMap(save=tmp_path / "b"),
    )
    on_a, on_b = (LastingMap(tmp_path / name, tmp_path / name) for name in "ab")
    whole = run(short_street, config, tmp_path / "whole", lasting_map=on_a).folder
    check_same(
        interrupt_and_resume(short_street, config, tmp_path / "result", 5, lasting_map=on_b), whole
    )
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_pictures_go_on_where_they_were(short_street, tmp_path) -> None:
    config, folder = load_config(None, QUICK), tmp_path / "result"
    run(short_street, config, folder, frames=8, sinks=[FrameWriter(every=3), Interrupter(4)])
    run(short_street, config, folder, frames=8, sinks=[FrameWriter(every=3)], resume=True)
    names = sorted(path.name for path in (folder / "frames").iterdir())
    assert names == ["000000.jpg", "000003.jpg", "000006.jpg"]


def loop_of(slam: DyObSlam) -> LoopClosure:
    """The latest keyframe as if it saw the place of the first, which it does, but 5 cm off."""
    last = len(slam.map.keyframes) - 1
    keyframe = slam.map.keyframes[last]
    off = exp_se3(np.array([0.0, 0.002, 0.0, 0.05, 0.0, 0.0]))
    return LoopClosure(last, 0, off @ keyframe.T_world_camera, keyframe.tracks[:0], off, 10.0)


def test_a_loop_that_is_being_closed_is_closed_and_settled_alike(short_street) -> None:
    config = load_config(None, ["mapping.keyframe_max_interval=3", "backend.process=false"])
    ours = DyObSlam(short_street.camera, config)
    for k in range(7):
        ours.process(short_street.read(k))
    loop = loop_of(ours)
    ours._backend._ask(ClosingQuestion(8, build_pose_graph(ours.map, [loop]), closes=loop))
    theirs = through_arrays(ours)
    for k in range(7, 10):
        one, other = (slam.process(short_street.read(k)) for slam in (ours, theirs))
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        np.testing.assert_array_equal(one.objects.centers_m, other.objects.centers_m)
    assert ours._backend.n_applied == theirs._backend.n_applied == 1
    np.testing.assert_array_equal(ours.static_map().points_m, theirs.static_map().points_m)
    ours._backend._settle_loop(ours.map, loop.keyframe, loop.place)
    theirs = through_arrays(ours)
    one, other = (slam._backend._judge(slam._backend._question) for slam in (ours, theirs))
    assert ours._backend.n_full == theirs._backend.n_full
    assert (one is None) == (other is None)
    if one is not None:
        np.testing.assert_array_equal(one.Ts_new, other.Ts_new)


def through_arrays(ours: DyObSlam) -> DyObSlam:
    """Another system that goes on from the same state."""
    theirs = DyObSlam(ours.camera, ours.config)
    classes = checkpoint._classes()
    encoder = GraphEncoder(classes, ours.fixed_parts())
    changing, root, fresh, _ = encoder.encode(ours.state())
    assert len(fresh) == 0
    decoder = GraphDecoder(classes, theirs.fixed_parts(), {})
    theirs.restore(decoder.decode(changing.arrays(root)))
    return theirs


# --------------------------------------------------------------- interruption


def test_ctrl_c_within_a_frame_waits_for_its_end(
    short_street, quick, tmp_path, monkeypatch
) -> None:
    config, folder = load_config(None, QUICK), tmp_path / "result"
    process = DyObSlam.process

    def interrupted(slam: DyObSlam, frame):
        if frame.frame.index == 6:
            signal.raise_signal(signal.SIGINT)
        return process(slam, frame)

    with monkeypatch.context() as patch:
        patch.setattr(DyObSlam, "process", interrupted)
        partial = run(short_street, config, folder)
    assert partial.metrics["run"]["frames"] == 7
    run(short_street, config, folder, resume=True)
    check_same(folder, quick)


def test_a_second_ctrl_c_does_not_wait_and_costs_the_frames_since_the_last_checkpoint(
    short_street, quick, tmp_path, monkeypatch
) -> None:
    config, folder = load_config(None, QUICK), tmp_path / "result"
    grow = DyObSlam._grow_map

    def interrupted(slam: DyObSlam, view, tracked):
        if view.frame_index == 6:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        return grow(slam, view, tracked)

    with monkeypatch.context() as patch:
        patch.setattr(DyObSlam, "_grow_map", interrupted)
        partial = run(short_street, config, folder, checkpoint_every=4)
    assert partial.metrics["run"]["frames"] == 6
    run(short_street, config, folder, resume=True)
    assert "resumed after 4 frames" in (folder / "run.log").read_text()
    check_same(folder, quick)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_run_that_was_killed_goes_on(quick, tmp_path, render_cache) -> None:
    folder = tmp_path / "result"
    program = (
        "import sys; from pipelines.io.config import load_config\n"
        "from pipelines.datasets import open_sequence; from pipelines.runner import run\n"
        "options = {'frames': 20, 'scale': 0.4, 'cache': sys.argv[1]}\n"
        "street = open_sequence('simulated:street', **options)\n"
        f"config = load_config(None, {list(QUICK)})\n"
        "run(street, config, sys.argv[2], frames=10, checkpoint_every=3)\n"
    )
    command = [sys.executable, "-c", program, str(render_cache), str(folder)]
    with subprocess.Popen(command, cwd=ROOT, env={**os.environ, "DYOB_NO_SETUP": "1"}) as process:
        log, deadline = folder / "run.log", time.monotonic() + 120
        while not (log.exists() and "frame 5 OK" in log.read_text()):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.005)
        process.kill()
    if not (folder / "checkpoint").exists():
        pytest.skip("the run had finished before it was killed")
    street = open_sequence("simulated:street", frames=20, scale=0.4, cache=render_cache)
    run(street, load_config(None, QUICK), folder, frames=10, resume=True)
    check_same(folder, quick)


def test_a_disk_that_refuses_costs_the_checkpoint_alone(
    short_street, quick, tmp_path, caplog
) -> None:
    folder = tmp_path / "result"

    class Blocker(Interrupter):
        def start(self, *_: object) -> None:
            (folder / "checkpoint").write_text("in the way")

        def frame(self, *_: object) -> None: ...

    run(short_street, load_config(None, QUICK), folder, sinks=[Blocker(0)], checkpoint_every=4)
    assert caplog.text.count("no checkpoint, the run goes on") >= 1
    warnings = [r for r in caplog.records if r.levelname == "WARNING"]
    assert len(warnings) == 1
    (folder / "checkpoint").unlink()
    check_same(folder, quick)
