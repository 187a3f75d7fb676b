"""The verb `prepare`: in a process of its own on a small stereo folder, and when it is stopped."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from app import arguments, cli, preparation
from pipelines.datasets import open_sequence
from pipelines.prepare import KINDS

ROOT = Path(__file__).resolve().parents[2]
N, WIDTH, HEIGHT, DISPARITY_PX = 3, 160, 96, 8


@pytest.fixture
def stereo_folder(tmp_path: Path) -> Path:
    """A textured wall 8 px of disparity away, which moves by 2 px a frame."""
    root = tmp_path / "wall"
    noise = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH + 40), dtype=np.uint8)
    wall = cv2.GaussianBlur(noise, (5, 5), 0)
    for k in range(N):
        for name, shift in (("images", 0), ("right", DISPARITY_PX)):
            (root / name).mkdir(parents=True, exist_ok=True)
            at = 10 + 2 * k + shift
            assert cv2.imwrite(str(root / name / f"{k:03d}.png"), wall[:, at : at + WIDTH])
    (root / "camera.yaml").write_text("fx: 100\nfy: 100\ncx: 80\ncy: 48\nbf: 40\nfps: 10\n")
    return root


def app(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "app", *map(str, words)],
        cwd=ROOT,
        env={**os.environ, "DYOB_NO_SETUP": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_prepare_fills_the_folder_and_says_how_to_use_it(stereo_folder: Path) -> None:
    words = ("prepare", stereo_folder, "--what", "depth,flow")
    done = app(*words)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "depth  3 made  0 kept" in done.stdout
    assert "flow   2 made  0 kept" in done.stdout
    assert f"python3 -m app run {stereo_folder}" in done.stdout
    assert "preparing: 3 of 3" in done.stderr
    frame = open_sequence(stereo_folder).read(1)
    assert np.nanmedian(frame.depth_m) == pytest.approx(40 / DISPARITY_PX, rel=0.01)
    assert np.median(frame.flow_prev_to_curr_px[..., 0]) == pytest.approx(-2.0, abs=0.1)
    again = app(*words, "--quiet")
    assert (again.returncode, again.stdout.strip(), again.stderr) == (0, str(stereo_folder), "")


def test_bad_wishes_are_one_sentence(stereo_folder: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        cli.build_parser().parse_args(["prepare", "x", "--what", "depth,speed"])
    assert "expected some of depth,flow,masks, found 'depth,speed'" in capsys.readouterr().err
    done = app("prepare", stereo_folder / "nothing")
    assert done.returncode == 2
    assert "found no such folder" in done.stderr


def test_a_stop_is_no_error_and_says_how_to_go_on(stereo_folder, monkeypatch, capsys) -> None:
    def stop(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.prepare.prepare", stop)
    arguments = cli.build_parser().parse_args(["prepare", str(stereo_folder)])
    assert preparation.prepare(arguments) == 130
    assert "the same command goes on from there" in capsys.readouterr().out


def test_the_words_are_those_of_the_work() -> None:
    assert arguments.KINDS == KINDS
