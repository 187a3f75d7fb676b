"""Live viewers: the table of sinks that show a run while it goes on.

Adding one is one file and one line here; the contract tests then run on it.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from importlib import import_module
from typing import Protocol

from pipelines.errors import ConfigError
from pipelines.runner import Sink

VIEWERS = {
    "meshcat": "viz.browser.live:LiveViewer",
}


class Viewer(Sink, Protocol):
    """What every viewer of the table offers: it never lets the run wait, and changes nothing."""

    n_left_out: int  # pictures that came too fast for the view, so far


def load_viewer(
    name: str,
    *,
    host: str | None = None,
    port: int | None = None,
    announce: Callable[[str], None] = lambda url: None,
) -> Viewer:
    """The viewer of that name, to be handed to `run` among its sinks.

    host, port: where it serves, by default on this machine alone and at the first free port.
    announce: called with what to open once it can be opened. Raises ConfigError for an unknown
    name.
    """
    if name not in VIEWERS:
        nearest = difflib.get_close_matches(name, VIEWERS, 1, 0.4)
        hint = f"did you mean {nearest[0]!r}? " if nearest else ""
        raise ConfigError(f"Unknown viewer {name!r}; {hint}There are: {', '.join(VIEWERS)}.")
    module, viewer = VIEWERS[name].split(":")
    return getattr(import_module(module), viewer)(host=host, port=port, announce=announce)
