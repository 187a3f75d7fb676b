"""`notebook`: JupyterLab on the folder notebooks/, until Ctrl-C.

Owns the server's process and the address that a person opens. The server listens on this machine
alone, behind the token that Jupyter makes for each start.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from app import console
from app.environment import ROOT
from pipelines.errors import DyObError

FOLDER = ROOT / "notebooks"
SETTINGS = FOLDER / ".jupyter"  # no questions about builds and news before the first look
_START_S = 120.0  # s, which a server may take until it answers; the first start compiles much
_STOP_S = 15.0  # s, to end its kernels in peace


def notebook(arguments: Namespace) -> int:
    """`notebook [NAME]`: 0 after Ctrl-C, else the exit code of a server that ended by itself."""
    page = _page(arguments.name)
    server = subprocess.Popen(
        _command(page, arguments),
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONPATH": _before("PYTHONPATH", ROOT),
            "JUPYTER_CONFIG_PATH": _before("JUPYTER_CONFIG_PATH", SETTINGS),
        },
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # else Ctrl-C reaches it too, and it asks whether one is sure
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        console.say(_address(server, page))
        console.say("Ctrl-C ends the notebooks and what they compute.")
        return server.wait()
    except KeyboardInterrupt:
        return 0
    finally:
        _stop(server)


def _page(name: str | None) -> str:
    """Path in the lab of a notebook; by its name, or how that begins."""
    if name is None:
        return "lab/tree/notebooks/01_walkthrough.ipynb"
    known = sorted(path.name for path in FOLDER.glob("*.ipynb"))
    wanted = Path(name).name
    found = [file for file in known if file.startswith(wanted.removesuffix(".ipynb"))]
    if len(found) != 1:
        raise DyObError(
            f"no notebook is called '{name}': expected one of {', '.join(known)}, or how its name "
            "begins"
        )
    return f"lab/tree/notebooks/{quote(found[0])}"


def _command(page: str, arguments: Namespace) -> list[str]:
    settings = [
        "--ServerApp.ip=127.0.0.1",
        f"--ServerApp.root_dir={ROOT}",
        f"--ServerApp.default_url=/{page}",
        "--log-level=WARN",
        "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate",
        "--LabApp.news_url=None",
    ]
    if arguments.port is not None:
        settings.append(f"--ServerApp.port={arguments.port}")
    if arguments.no_browser:
        settings.append("--no-browser")
    if os.geteuid() == 0:  # as in a container; Jupyter refuses that unless told
        settings.append("--allow-root")
    return [sys.executable, "-m", "jupyterlab", *settings]


def _before(variable: str, folder: Path) -> str:
    """The folder, and after it what the environment names in a variable of paths."""
    paths = os.environ.get(variable, "")
    return os.pathsep.join([str(folder), *([paths] if paths else [])])


def _address(server: subprocess.Popen[bytes], page: str) -> str:
    """The address with its token, once the server has left a note of it."""
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        if server.poll() is not None:
            break
        found = _note_of(server.pid)
        if found is not None:
            return f"{found['url']}{page}?token={found['token']}"
        time.sleep(0.2)
    raise DyObError("JupyterLab did not start; what it said stands above")


def _note_of(pid: int) -> dict[str, Any] | None:
    from jupyter_server.serverapp import list_running_servers

    return next((note for note in list_running_servers() if note["pid"] == pid), None)


def _stop(server: subprocess.Popen[bytes]) -> None:
    """End the server and, through it, its kernels; a second Ctrl-C does not leave it behind."""
    if server.poll() is not None:
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    server.terminate()
    try:
        server.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()
