"""The verb that shows a result in the browser, and the viewer that `run --viewer` adds to a run.

Owns what a person is told about addresses, and whether a browser is started. The page and its
server are `viz.browser`.
"""

from __future__ import annotations

import os
import threading
import webbrowser
from argparse import Namespace
from contextlib import suppress
from pathlib import Path
from typing import Any

from app import console
from pipelines.errors import ConfigError


def view(arguments: Namespace) -> int:
    """`view RESULT`: serve it until Ctrl-C, or write the self-contained page and end."""
    from pipelines.io.result import load_result
    from viz.browser import export_scene
    from viz.browser.recorded import RecordedServer

    result = load_result(arguments.result)
    if arguments.export is not None:
        with console.working(f"writing {arguments.export}"):
            path = export_scene(result, Path(arguments.export))
        console.pictures([path])
        return 0
    with console.working(f"reading {console.shorten(result.folder)}"):
        server = RecordedServer(result, host=arguments.host, port=arguments.port)
    server.start()
    try:
        announce(server.url, open_browser=not arguments.no_open)
        console.stderr.print("Ctrl-C ends it.", highlight=False)
        with suppress(KeyboardInterrupt):
            threading.Event().wait()
    finally:
        server.stop()
    return 0


def live_viewer(arguments: Namespace) -> Any:
    """The sink that `--viewer` names, or None. Raises ConfigError for a flag that needs it."""
    if arguments.viewer is None:
        for flag, value in (("host", arguments.host), ("port", arguments.port)):
            if value is not None:
                raise ConfigError(
                    f"--{flag} is of the viewer, and none is asked for: add --viewer meshcat, or "
                    f"leave --{flag} out"
                )
        return None
    from viz.viewers import load_viewer

    opens = not arguments.no_open
    return load_viewer(
        arguments.viewer,
        host=arguments.host,
        port=arguments.port,
        announce=lambda url: announce(url, open_browser=opens),
    )


def announce(url: str, *, open_browser: bool) -> None:
    """Say where the viewer is, and open it there where there is a desktop to do so."""
    console.stderr.print(f"The viewer is at {url}", highlight=False, markup=False, soft_wrap=True)
    if "?token=" in url:
        console.stderr.print(
            "Others reach it too, but only with the whole address: keep its token private.",
            highlight=False,
        )
    if open_browser and any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        webbrowser.open(url)
