"""`notebook`: a server behind its token, on this machine alone, that Ctrl-C ends."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from argparse import Namespace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from app import notebook
from pipelines.errors import DyObError

ROOT = Path(__file__).resolve().parents[2]


def status(url: str) -> int:
    """HTTP status of an address; a redirection, as to the page that asks for the token, counts."""

    class Stay(urllib.request.HTTPRedirectHandler):
        def redirect_request(self, *arguments: object) -> None:
            return None

    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), Stay)
    try:
        with opener.open(url, timeout=60) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def page_settings(url: str) -> dict[str, Any]:
    """What the lab's page is told by its server."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=60) as answer:
        page = answer.read().decode()
    found = re.search(r'id="jupyter-config-data"[^>]*>(.*?)</script>', page, re.DOTALL)
    assert found is not None, page[:500]
    return dict(json.loads(found[1]))


@pytest.mark.parametrize(
    ("name", "file"),
    [(None, "01_walkthrough"), ("02", "02_moving_objects"), ("03_your_own_data.ipynb",) * 2],
)
def test_a_notebook_is_found_by_how_its_name_begins(name: str | None, file: str) -> None:
    assert notebook._page(name) == f"lab/tree/notebooks/{file.removesuffix('.ipynb')}.ipynb"


@pytest.mark.parametrize("name", ["0", "04", "walkthrough"])
def test_other_names_are_a_sentence(name: str) -> None:
    with pytest.raises(DyObError, match=r"expected one of 01_walkthrough.ipynb, 02_moving"):
        notebook._page(name)


def test_it_listens_on_this_machine_alone() -> None:
    command = notebook._command("lab", Namespace(port=8899, no_browser=True))
    assert "--ServerApp.ip=127.0.0.1" in command and "--ServerApp.port=8899" in command
    assert not any("token" in word or "password" in word for word in command)


def test_the_address_that_it_prints_opens_and_ctrl_c_ends_it(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "app", "notebook", "02", "--no-browser"]
    environment = {
        **os.environ,
        "DYOB_NO_SETUP": "1",
        **{f"JUPYTER_{kind}_DIR": str(tmp_path / kind) for kind in ("CONFIG", "DATA", "RUNTIME")},
    }
    with (
        (tmp_path / "log").open("wb") as log,
        subprocess.Popen(
            command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=log, text=True
        ) as running,
    ):
        assert running.stdout is not None
        url = running.stdout.readline().strip()
        try:
            assert "/lab/tree/notebooks/02_moving_objects.ipynb" in url, (
                tmp_path / "log"
            ).read_text()
            parts = urlsplit(url)
            assert parts.hostname == "127.0.0.1" and len(parse_qs(parts.query)["token"][0]) > 20
            assert status(url) == 200
            settings = page_settings(url)
            assert not settings["buildCheck"] and not settings["buildAvailable"]
            assert "@jupyterlab/apputils-extension:announcements" in settings["disabledExtensions"]
            contents = f"http://{parts.netloc}/api/contents/notebooks"
            assert status(contents) == 403
            assert status(f"{contents}?{parts.query}") == 200
        finally:
            running.send_signal(signal.SIGINT)
        try:
            assert running.wait(timeout=60) == 0
        finally:
            running.terminate()
    with pytest.raises(urllib.error.URLError):
        status(contents)
    assert "Traceback" not in (tmp_path / "log").read_text()
