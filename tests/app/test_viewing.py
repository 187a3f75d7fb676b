"""`view` in a process of its own: it serves until Ctrl-C, or writes a page and ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from app import cli, viewing
from pipelines.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "DYOB_NO_SETUP": "1", "PYTHONUNBUFFERED": "1"}


@pytest.fixture
def folder(tmp_path) -> Path:
    """The least that is a result: a camera that went ahead."""
    rows = [f"{0.1 * k:.6f} 0 0 {0.5 * k} 0 0 0 1" for k in range(6)]
    (tmp_path / "camera_tum.txt").write_text("\n".join(rows), encoding="utf-8")
    return tmp_path


def start(*words: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "app", "view", *map(str, words)],
        cwd=ROOT,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_page_is_written(folder, tmp_path):
    file = tmp_path / "my_scene.html"
    with start(folder, "--export", file) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert out.strip() == str(file)
    assert "dyob-data" in file.read_text(encoding="utf-8")


def test_it_serves_until_ctrl_c(folder):
    with start(folder, "--no-open", "--host", "0.0.0.0") as process:
        assert process.stderr is not None
        lines = iter(process.stderr.readline, "")
        line = next(line for line in lines if "The viewer is at" in line)
        url = line.split()[-1]
        port = url.split("/")[2].rsplit(":", 1)[1]
        token = url.split("?token=")[1]
        assert "keep its token private" in next(lines)
        page = urllib.request.urlopen(f"http://127.0.0.1:{port}/?token={token}", timeout=60)
        assert b"DyOb-SLAM" in page.read()
        next(line for line in lines if "Ctrl-C" in line)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "Traceback" not in err


def test_a_wrong_folder_is_told_in_a_sentence(tmp_path):
    with start(tmp_path / "nothing") as process:
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and "expected a result folder, found nothing" in err


def test_a_run_has_a_viewer_only_where_one_is_asked_for():
    parse = cli.build_parser().parse_args
    assert viewing.live_viewer(parse(["run", "data"])) is None
    viewer = viewing.live_viewer(parse(["run", "data", "--viewer", "meshcat", "--port", "7105"]))
    assert (viewer.host, viewer.port) == (None, 7105)
    with pytest.raises(ConfigError, match="--port is of the viewer"):
        viewing.live_viewer(parse(["run", "data", "--port", "7105"]))


def test_a_browser_is_started_only_where_there_is_a_desktop(monkeypatch):
    opened: list[str] = []
    monkeypatch.setattr(viewing.webbrowser, "open", opened.append)
    for display, wanted, expected in (("", True, 0), (":0", False, 0), (":0", True, 1)):
        monkeypatch.setenv("DISPLAY", display)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        viewing.announce("http://127.0.0.1:7000/", open_browser=wanted)
        assert len(opened) == expected
