"""The doctor's findings: on this machine, on data that lack something, and on real sequences."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from app import doctor, system_libraries
from app.doctor import Verdict
from app.environment import Environment
from pipelines.errors import DatasetError, FrameError
from pipelines.types import Frame, GroundTruth, StereoCamera


class Sequence:
    """Two small frames, changed by what a test passes."""

    name, dataset = "small", "folder"
    camera = StereoCamera(8, 6, 10.0, 10.0, 4.0, 3.0, 5.0)

    def __init__(self, n=2, truth=None, error=None, **parts) -> None:
        self.timestamps_s = np.arange(n) * 0.1
        self.truth, self.error, self.parts = truth, error, parts

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int) -> Frame:
        if self.error:
            raise self.error
        image = self.parts.get("image", np.full((6, 8), 9, np.uint8))
        return Frame(index, index * 0.1, **{**self.parts, "image": image})

    def ground_truth(self):
        return self.truth


def findings(monkeypatch, sequence) -> dict[str, doctor.Finding]:
    monkeypatch.setattr("pipelines.datasets.open_sequence", lambda *a: sequence)
    return {finding.subject: finding for finding in doctor.data("x", None, None)}


def test_a_full_sequence_is_fit(monkeypatch) -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:3] = np.nan
    labels = np.zeros((6, 8), np.int32)
    labels[0, :2] = 1, 4
    truth = GroundTruth(np.zeros(2), np.zeros((2, 4, 4)))
    flow = np.zeros((6, 8, 2), np.float32)
    found = findings(
        monkeypatch,
        Sequence(truth=truth, depth_m=depth, instance_labels=labels, flow_prev_to_curr_px=flow),
    )
    assert {finding.verdict for finding in found.values()} == {Verdict.OK}
    assert found["frame 1"].words == (
        "grey image, depth at 50% of the pixels, 2.0 to 2.0 m, flow, masks of 2"
    )
    assert found["frames"].words == "2, 0.1 s at 10.0 fps"
    assert found["ground truth"].words == "2 poses"
    assert found["camera"].words == "8x6, focal length 10.0 px, baseline 500 mm"


def test_masks_that_name_classes_are_told(monkeypatch) -> None:
    labels = np.array([[1, 2, 5]], np.int32).repeat(6, 0).repeat(3, 1)[:, :8]
    classes = {1: "car", 2: "car", 5: "bus"}
    found = findings(monkeypatch, Sequence(instance_labels=labels, instance_classes=classes))
    assert "masks of 3 (bus, car)" in found["frame 1"].words


def test_a_right_image_is_as_good_as_depth(monkeypatch) -> None:
    found = findings(monkeypatch, Sequence(image_right=np.zeros((6, 8), np.uint8)))
    assert found["frame 0"].verdict is Verdict.OK


@pytest.mark.parametrize("depth", [None, np.full((6, 8), np.nan, np.float32)])
def test_neither_depth_nor_a_right_image_is_unfit(monkeypatch, depth) -> None:
    found = findings(monkeypatch, Sequence(depth_m=depth))
    assert found["frame 0"].verdict is Verdict.UNFIT
    assert "neither depth nor a right image" in found["frame 0"].words


def test_black_frames_are_named(monkeypatch) -> None:
    found = findings(monkeypatch, Sequence(image=np.zeros((6, 8), np.uint8)))
    assert "BLACK" in found["frame 0"].words


def test_one_frame_is_no_sequence(monkeypatch) -> None:
    found = findings(monkeypatch, Sequence(n=1, image_right=np.zeros((6, 8), np.uint8)))
    assert found["frames"].verdict is Verdict.UNFIT
    assert "frame 0" in found


def test_no_truth_is_a_note(monkeypatch) -> None:
    assert findings(monkeypatch, Sequence())["ground truth"].verdict is Verdict.NOTE


def test_unreadable_frames_are_reported_with_their_error(monkeypatch) -> None:
    found = findings(monkeypatch, Sequence(error=FrameError("000000.png is damaged")))
    assert found["frame 0"].verdict is Verdict.UNFIT
    assert found["frame 1"].words == "000000.png is damaged"


def test_a_layout_that_cannot_be_opened_is_the_only_finding(monkeypatch) -> None:
    def fail(*arguments):
        raise DatasetError("expected image_0/, found nothing")

    monkeypatch.setattr("pipelines.datasets.open_sequence", fail)
    (found,) = doctor.data("x", None, None)
    assert (found.verdict, found.words) == (Verdict.UNFIT, "expected image_0/, found nothing")


@pytest.mark.parametrize(
    ("root", "verdict"), [(True, Verdict.NOTE), (False, Verdict.UNFIT)], ids=["root", "user"]
)
def test_missing_libraries_stand_in_the_way_of_a_user(
    monkeypatch, repository, root, verdict
) -> None:
    monkeypatch.delenv("DYOB_NO_SETUP", raising=False)
    monkeypatch.setattr(system_libraries, "missing_required", lambda: {"libGL.so.1": "libgl1"})
    monkeypatch.setattr(system_libraries, "missing_rendering", lambda: {"libv": "libvulkan1"})
    monkeypatch.setattr(system_libraries, "can_install", lambda: root)
    found = {f.subject: f for f in doctor.machine(Environment.read(repository))}
    assert found["system libraries"].verdict is verdict
    assert "libgl1" in found["system libraries"].words
    assert found["Vulkan"].verdict is Verdict.NOTE


def test_missing_packages_matter_only_without_set_up(monkeypatch, repository) -> None:
    monkeypatch.setattr(doctor, "missing_packages", lambda pins: dict.fromkeys(pins, "nothing"))
    for no_setup, verdict in (("", Verdict.NOTE), ("1", Verdict.UNFIT)):
        monkeypatch.setenv("DYOB_NO_SETUP", no_setup)
        found = {f.subject: f for f in doctor.machine(Environment.read(repository))}
        assert found["packages: core"].verdict is verdict
        assert found["packages: torch"].verdict is Verdict.NOTE
    assert "lacks numpy 2" in found["packages: core"].words


def test_the_exit_code_follows_the_findings(monkeypatch, capsys) -> None:
    for verdict, code, closing in (
        (Verdict.OK, 0, "Fit: this machine."),
        (Verdict.NOTE, 0, "Fit: this machine."),
        (Verdict.UNFIT, 1, "Not fit yet: disk."),
    ):
        finding = doctor.Finding(verdict, "disk", "words")
        monkeypatch.setattr(doctor, "_all_findings", lambda arguments, f=finding: iter([f]))
        assert doctor.doctor(SimpleNamespace(path=None)) == code
        assert capsys.readouterr().out.splitlines()[-1] == closing


def run_doctor(repository: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "app", "doctor", *arguments],
        cwd=repository,
        env={**os.environ, "DYOB_NO_SETUP": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_an_empty_folder_is_unfit(repository: Path, tmp_path: Path) -> None:
    done = run_doctor(repository, str(tmp_path))
    assert done.returncode == 1
    assert "UNFIT  layout" in done.stdout
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("name", "dataset", "n_frames"),
    [
        ("7scenes_redkitchen_200f", "tum_rgbd", 200),
        ("kitti_odom06_000-050_stereo", "kitti_odometry", 51),
        ("kitti_tracking_0003_vdo_format_10f", "vdo", 10),
    ],
)
def test_real_sequences_are_recognised(repository, real_data, name, dataset, n_frames) -> None:
    done = run_doctor(repository, str(real_data(name)))
    lines = {line[7:25].strip(): line[26:] for line in done.stdout.splitlines() if line[:6].strip()}
    assert done.returncode == 0, done.stdout + done.stderr
    assert lines["layout"].startswith(f"{dataset}, ")
    assert lines["frames"].startswith(f"{n_frames}, ")
    assert "poses" in lines["ground truth"]
