"""What the README promises: its script runs, its commands parse, its files and names exist."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from app import cli
from pipelines.datasets import open_sequence

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^python3 -m app (.+?)(?:\s+#.*)?$", README, re.MULTILINE)


def test_the_script_runs(tmp_path: Path) -> None:
    (script,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    first, second, third = done.stdout.splitlines()
    assert 0 < float(first.split()[-1]) < 0.01
    ids, speed_mps = second.rsplit(" ", 1)
    assert len(ids.split(",")) >= 2 and 5 < float(speed_mps) < 20
    assert third == "(40, 4, 4)"


def test_the_example_of_own_data_opens(tmp_path: Path) -> None:
    (yaml,) = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    (tmp_path / "camera.yaml").write_text(yaml, encoding="utf-8")
    for folder, pixel in (("images", np.uint8), ("depth", np.uint16)):
        (tmp_path / folder).mkdir()
        image = np.full((480, 640), 200, pixel)
        assert all(cv2.imwrite(str(tmp_path / folder / f"{k:06d}.png"), image) for k in range(2))
    sequence = open_sequence(tmp_path)
    frame = sequence.read(1)
    assert (sequence.dataset, sequence.camera.is_rgbd) == ("folder", True)
    assert sequence.timestamps_s[1] == pytest.approx(1 / 30)
    assert frame.depth_m is not None
    assert np.allclose(frame.depth_m, 0.2)


def test_there_are_commands() -> None:
    assert {shlex.split(command)[0] for command in COMMANDS} >= {"demo", "test", "run", "render"}


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_parses(command: str) -> None:
    arguments = cli.build_parser().parse_args(shlex.split(command))
    assert arguments.verb == shlex.split(command)[0]


@pytest.mark.parametrize("picture", re.findall(r"\]\((\.github/[^)]+)\)", README))
def test_each_picture_is_there_and_light(picture: str) -> None:
    assert (ROOT / picture).stat().st_size < 400_000


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", README))))
def test_each_file_is_where_it_says(path: str) -> None:
    assert (ROOT / path).is_file() or (ROOT / "pipelines" / path).is_file()
