"""What report.html says of a run's settings and files.

Owns the words for each file of a result folder.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

from pipelines.config import Config
from pipelines.io import folder as names
from pipelines.io.config import config_to_dict
from pipelines.io.result import Result
from viz.markup import Html, table

MEANINGS = {
    names.CAMERA_TUM: "the camera's poses, TUM: time x y z qx qy qz qw",
    names.CAMERA_KITTI: "the same of every frame, KITTI: a 3x4 matrix a line",
    names.CAMERA_GT_TUM: "the true camera, in this run's world",
    names.CAMERA_STD: "standard deviations of the camera's poses after the batch",
    names.OBJECTS_CSV: "a row per object and frame: state, box, pose, motion, speed",
    names.OBJECTS_GT_CSV: "the true objects, in this run's world",
    names.STATIC_MAP: "the sparse static map with colours, PLY",
    names.OBJECTS_MAP: "objects' points where they were last, and their ways, in their colours",
    names.METRICS_JSON: "errors and counts",
    names.METRICS_TXT: "the same for people",
    names.TIMINGS: "time of every stage and frame",
    names.CONFIG: "all settings of the run",
    names.LOG: "what happened, frame by frame",
    names.SCENE: "the run in 3D, a page of its own",
    names.OBJECTS: "a trajectory per object, TUM",
    names.OBSERVATIONS: "what every frame saw, for `optimize`",
    names.FRONT_END: "the answers before the global batch",
    names.FRAMES: "annotated frames",
    names.RENDERS: "pictures of the map",
    names.PLOTS: "diagrams",
}


def settings_section(result: Result) -> Html:
    """The settings that are not the default ones, and all of them folded away."""
    given = dict(_flat(result.config))
    if not given:
        return Html("<section><h2>Settings</h2><p>The run has left none.</p></section>")
    default = dict(_flat(config_to_dict(Config())))
    changed = [
        (Html(f"<code>{escape(name)}</code>"), _plain(value), _plain(default.get(name)))
        for name, value in given.items()
        if value != default.get(name)
    ]
    body = "<h2>Settings</h2>"
    if changed:
        body += table(("", "here", "by default"), changed)
    else:
        body += "<p>All are the default ones.</p>"
    rows = [(Html(f"<code>{escape(name)}</code>"), _plain(value)) for name, value in given.items()]
    body += f"<details><summary>All {len(rows)} settings</summary>{table((), rows)}</details>"
    return Html(f"<section>{body}</section>")


def files_section(folder: Path) -> Html:
    """Files and folders of the result that are there, as links."""
    rows = []
    for path in sorted(folder.iterdir(), key=lambda p: (p.is_dir(), p.name)):
        if path.name.startswith(".") or path.name == names.REPORT:
            continue
        if path.is_dir():
            held = sum(1 for inner in path.iterdir() if inner.is_file())
            if not held:
                continue
            name, size = f"{path.name}/", f"{held} file{'s' * (held != 1)}"
        else:
            name, size = path.name, _size(path.stat().st_size)
        link = Html(f'<a href="{escape(name)}">{escape(name)}</a>')
        rows.append((link, size, MEANINGS.get(path.name, "")))
    return Html(f"<section><h2>Files</h2>{table((), rows)}</section>")


def _flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _plain(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else str(value)


def _size(n_bytes: int) -> str:
    if n_bytes >= 1_000_000:
        return f"{n_bytes / 1e6:.1f} MB"
    return f"{max(n_bytes / 1e3, 0.1):.1f} kB" if n_bytes < 10_000 else f"{n_bytes / 1e3:.0f} kB"
