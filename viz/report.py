"""`report.html` of a result folder: all that there is to tell of a run, on one page.

Owns what the page says and in which order. Its tables are those of `evaluation.table` and its
figures the folder's own; nothing is computed but what a row of an object sums up. The style sheet
is report.css beside this file.
"""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluation import table as words
from pipelines.io import folder as names
from pipelines.io.files import write_text
from pipelines.io.result import Result
from viz.markup import Html, figure, page_frame, table
from viz.playback import Playback, build_playback
from viz.report_objects import moving_chips, objects_section
from viz.report_run import files_section, settings_section

LARGEST_BYTES = 12_000_000
SCENE_HEIGHT_PX = 560
SMALL_SCENE_MB = 5.0
N_FRAMES = 4
KEY_OF_FRAMES = (
    "Green rings agree with the camera's pose, red crosses do not. What moves has a box and its "
    "speed."
)
LIVE_FRAMES = "They show what was known live; all else on this page is after the global batch."
CAPTIONS = {
    "map_top": "The static map from above, with the ways of the camera and of all that moved.",
    "map_iso": "The same from the side.",
    "map_chase": "One moment from behind the camera: objects in their boxes, over the map.",
    "trajectory": "The camera's path from above, and its distance to the truth.",
    "rpe": "Error of every single step of the camera.",
    "objects_speed": "Speeds of moving objects: single frames, and the filter's 95 % interval.",
    "objects_motion": "Errors of each moving object's motion in one frame.",
    "objects_timeline": "Which object was known when, and whether it moved.",
    "timings": "What a frame costs, over time and by stage.",
}


def write_report(result: Result) -> Path:
    """Write report.html into a result's folder, and scene.html beside it; the path of the first.

    The page stands alone: pictures are inside, nothing is fetched. It shows the renders, plots and
    annotated frames that are in the folder, so make these first. What a run lacks (truth, objects,
    a batch, its end) is left out, in words where one would look for it.
    """
    playback = build_playback(result)
    parts = [
        _headline(result),
        _pictures(result, playback),
        _errors(result),
        objects_section(result, playback),
        _plots(result),
        _timings(result),
        settings_section(result),
        files_section(result.folder),
    ]
    scene = _scene(result, sum(map(len, parts)))
    title = str(result.metrics.get("run", {}).get("sequence") or result.folder.name)
    style = (Path(__file__).parent / "report.css").read_text(encoding="utf-8")
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{escape(title)} · DyOb-SLAM</title>'
        f"<style>{style}</style></head><body>{parts[0]}{scene}{''.join(parts[1:])}</body></html>\n"
    )
    path = result.folder / names.REPORT
    write_text(path, page)
    return path


# ------------------------------------------------------------------------------ sections


def _headline(result: Result) -> Html:
    run, camera = result.metrics.get("run", {}), result.metrics.get("camera", {})
    title = str(run.get("sequence") or result.folder.name)
    kind = f" · {escape(run['dataset'])}" if run.get("dataset") else ""
    body = f'<header><h1>{escape(title)}</h1><p class="soft">DyOb-SLAM{kind}</p>'
    if run.get("interrupted"):
        body += '<p class="alarm">Stopped before its end: this is what was done by then.</p>'
    elif not result.metrics:
        body += '<p class="alarm">Unfinished: the run has written no metrics.</p>'
    stamps = result.timestamps_s
    way_m = np.linalg.norm(np.diff(result.Ts_world_camera[:, :3, 3], axis=0), axis=1).sum()
    frames = run.get("frames", len(stamps))
    facts = [(f"{run.get('tracked', len(stamps))} of {frames}", "frames tracked")]
    if len(stamps) > 1:
        facts.append((f"{way_m:.1f} m", f"camera's way in {stamps[-1] - stamps[0]:.1f}\u00a0s"))
    facts.append((f"{len(result.static_points_m):,}", "points of the static map"))
    if camera.get("ate_rmse_m") is not None:
        facts.append((f"{100 * camera['ate_rmse_m']:.2g} cm", "off the true path (ATE)"))
    speed = result.metrics.get("objects", {}).get("speed", {})
    if speed.get("error_mean_kmh") is not None:
        facts.append((f"{speed['error_mean_kmh']:.2f} km/h", "mean error of speeds"))
    tiles = "".join(
        f"<li><strong>{escape(value)}</strong><span>{escape(meaning)}</span></li>"
        for value, meaning in facts
    )
    return Html(
        f'{body}<p class="lead">{moving_chips(result)}</p><ul class="facts">{tiles}</ul></header>'
    )


def _scene(result: Result, n_bytes: int) -> Html:
    """The run in 3D, which is scene.html too; with fewer pictures where the page grew too large."""
    from viz.browser import scene_html

    page = scene_html(result)
    write_text(result.folder / names.SCENE, page)
    frame = page_frame(page, SCENE_HEIGHT_PX, "The run in 3D")
    if n_bytes + len(frame) > LARGEST_BYTES:
        page = scene_html(result, max_mb=SMALL_SCENE_MB)
        frame = page_frame(page, SCENE_HEIGHT_PX, "The run in 3D")
    if n_bytes + len(frame) <= LARGEST_BYTES:
        body = f'<div class="scene">{frame}</div>'
        body += '<p class="soft">Turn it with the mouse or a finger; play it with the slider.</p>'
    else:
        link = f'<a href="{names.SCENE}">{names.SCENE}</a>'
        body = f"<p>{link} beside this page, which it would make too large.</p>"
    return Html(f'<section class="screen"><h2>In 3D</h2>{body}</section>')


def _pictures(result: Result, playback: Playback) -> Html:
    """The map, and the frames in which most moves."""
    body = "".join(
        figure(path, CAPTIONS.get(path.stem, _title(path)), photo=True)
        for path in _images(result.folder / names.RENDERS, "map_*.png")
    )
    for path in sorted((result.folder / names.RENDERS).glob("*.mp4")):
        address = f"{names.RENDERS}/{path.name}"
        body += f'<p>The run as a video, beside this page: <a href="{address}">{address}</a></p>'
    if body:
        body = f"<h2>Map</h2>{body}"
    chosen = _telling_frames(playback)
    if chosen:
        said = f"{KEY_OF_FRAMES} {LIVE_FRAMES}" if playback.is_optimised else KEY_OF_FRAMES
        body += f'<h2>Frames</h2><p class="soft">{said}</p>'
        for k in chosen:
            at = f"Frame {playback.frame_index[k]}, {playback.timestamps_s[k]:.2f} s"
            body += figure(_picture(playback, k), at, photo=True)
    return Html(f"<section>{body}</section>" if body else "")


def _telling_frames(playback: Playback) -> list[int]:
    """Frames from all parts of a run, of each part the one in which most moves."""
    with_picture = [k for k, path in enumerate(playback.pictures) if path is not None]
    parts = np.array_split(np.array(with_picture, int), min(N_FRAMES, len(with_picture)) or 1)
    movers = [sum(box.state == "moving" for box in boxes) for boxes in playback.boxes]
    return [int(part[np.argmax([movers[k] for k in part])]) for part in parts if len(part)]


def _picture(playback: Playback, k: int) -> Path:
    path = playback.pictures[k]
    assert path is not None
    return path


def _errors(result: Result) -> Html:
    metrics = result.metrics
    heading = ("", "RMSE", "mean", "median", "largest", "")
    camera = [*words.error_rows(metrics), *_padded(words.single_rows(metrics))]
    objects, found = words.object_error_rows(metrics), words.object_facts(metrics)
    batch = words.batch_rows(metrics)
    tables = (
        ("Camera", heading, camera),
        ("Objects in motion", heading, objects),
        ("Objects found", (), found),
        ("Global batch", ("", "before", "after", ""), batch),
    )
    body = "".join(
        f"<div><h3>{title}</h3>{table(names, rows)}</div>" for title, names, rows in tables if rows
    )
    body = f'<div class="pair">{body}</div>' if body else ""
    if not (camera or objects):
        body += "<p>There is no ground truth, so there are no errors to tell.</p>"
    if metrics and not batch:
        body += '<p class="soft">No global batch was run.</p>'
    return Html(f"<section><h2>Errors</h2>{body}</section>")


def _padded(rows: Iterable[words.Row]) -> list[words.Row]:
    return [(label, value, "", "", "", unit) for label, value, unit in rows]


def _plots(result: Result) -> Html:
    paths = _images(result.folder / names.PLOTS, "*.png")
    if not paths:
        return Html("")
    body = "".join(figure(path, CAPTIONS.get(path.stem, _title(path))) for path in paths)
    return Html(f'<section><h2>Diagrams</h2><div class="plots">{body}</div></section>')


def _timings(result: Result) -> Html:
    rows = words.timing_rows(result.timings)
    if not rows:
        return Html("")
    facts = words.run_facts(result.metrics)
    run = f"<div><h3>What was done</h3>{table((), facts)}</div>" if facts else ""
    times = table(("", "median", "95 %", ""), rows)
    body = f'<div class="pair">{run}<div><h3>Time a frame</h3>{times}</div></div>'
    return Html(f"<section><h2>Run</h2>{body}</section>")


def _images(folder: Path, pattern: str) -> list[Path]:
    """Pictures in a folder, those that this program makes first and in their order."""
    found = {path.stem: path for path in sorted(folder.glob(pattern))}
    known = [found.pop(stem) for stem in CAPTIONS if stem in found]
    return [*known, *found.values()]


def _title(path: Path) -> str:
    text: Any = path.stem.replace("_", " ")
    return f"{text[:1].upper()}{text[1:]}."
