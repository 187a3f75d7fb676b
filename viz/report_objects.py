"""What report.html says of objects: who moved and how fast, in words and as a table.

Owns the sums of an object's rows. Colours are those of every other picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.io.result import Result
from pipelines.object_types import ObjectState
from viz import style
from viz.markup import Html, table
from viz.object_marks import KMH, speed_words
from viz.object_plots import MIN_MOVING_FRAMES
from viz.playback import Playback

_FOLDED = 30  # rows of objects that stood still, above which they are folded away
_CHIPS = 8


@dataclass(frozen=True, slots=True)
class ObjectSummary:
    """An object over a run: frames in which it was seen and moved, speeds in km/h, way in m."""

    object_id: int
    class_name: str
    n_seen: int
    n_moving: int
    median_kmh: float
    top_kmh: float
    top_std_kmh: float
    way_m: float


def summarise_objects(result: Result, playback: Playback) -> list[ObjectSummary]:
    """All objects of a run, those that moved longest first."""
    objects = result.objects
    way_m: dict[int, float] = {}
    for trail in playback.trails:
        length_m = float(np.linalg.norm(np.diff(trail.points_m, axis=0), axis=1).sum())
        way_m[trail.object_id] = way_m.get(trail.object_id, 0.0) + length_m
    summaries = []
    for object_id in np.unique(objects.object_id).tolist():
        own = objects[objects.object_id == object_id]
        moving = own[(own.state == str(ObjectState.MOVING)) & np.isfinite(own.speed_mps)]
        kmh, std_kmh = KMH * moving.speed_mps, KMH * moving.speed_std_mps
        top = int(kmh.argmax()) if len(kmh) else -1
        summaries.append(
            ObjectSummary(
                object_id,
                str(own.class_name[-1]),
                int((own.state != str(ObjectState.COASTING)).sum()),
                len(kmh),
                float(np.median(kmh)) if len(kmh) else np.nan,
                float(kmh[top]) if len(kmh) else np.nan,
                float(std_kmh[top]) if len(kmh) else np.nan,
                way_m.get(object_id, 0.0),
            )
        )
    return sorted(summaries, key=lambda s: (-s.n_moving, s.object_id))


def moving_chips(result: Result) -> Html:
    """The headline: what moved for longer than a moment, with its median speed."""
    objects = result.objects
    moving = objects[objects.state == str(ObjectState.MOVING)]
    ids, counts = np.unique(moving.object_id, return_counts=True)
    lasting = ids[np.argsort(-counts, kind="stable")]
    lasting = lasting[np.sort(-counts) <= -MIN_MOVING_FRAMES]
    if len(lasting) == 0:
        return Html("Nothing moved for longer than a moment." if len(objects) else "No objects.")
    parts = []
    for object_id in lasting[:_CHIPS].tolist():
        own = moving[moving.object_id == object_id]
        speed = np.nanmedian(own.speed_mps) if np.isfinite(own.speed_mps).any() else np.nan
        said = f" at {speed_words(KMH * speed)}" if np.isfinite(speed) else ""
        parts.append(f"{chip(object_id)} {own.class_name[-1]}{said}")
    more = len(lasting) - len(parts)
    text = ", ".join(parts) + (f" and {more} more" if more else "")
    return Html(f"In motion: {text}.")


def chip(object_id: int) -> Html:
    """The object's number on its lasting colour."""
    color = style.object_color(object_id)
    ink = style.hex_color(style.ink_on(color))
    return Html(
        f'<span class="chip" style="background:{style.hex_color(color)};color:{ink}">'
        f"{object_id}</span>"
    )


def objects_section(result: Result, playback: Playback) -> Html:
    """Objects that moved, a row each, and the others folded away where they are many."""
    summaries = summarise_objects(result, playback)
    if not summaries:
        return Html("<section><h2>Objects</h2><p>No objects were tracked.</p></section>")
    errors = _errors_kmh(result)
    heading = ["", "class", "frames seen", "moving", "median km/h", "top km/h", "way, m"]
    if errors:
        heading.append("off by km/h")
    moved = [s for s in summaries if s.n_moving]
    still = [s for s in summaries if not s.n_moving]
    body = "<h2>Objects</h2>"
    if moved:
        rows = [_row(s, errors) for s in moved]
        body += table(heading, rows)
        body += '<p class="soft">Speeds by eq. (6), the largest with its standard deviation'
        body += "; the last column is the mean error of the speed.</p>" if errors else ".</p>"
    else:
        body += "<p>None of them was seen moving.</p>"
    if still:
        rest = table(heading[:3], [_row(s, {})[:3] for s in still])
        body += f"<details{'' if len(still) > _FOLDED or moved else ' open'}><summary>{len(still)} "
        body += f"that were not seen moving</summary>{rest}</details>"
    return Html(f"<section>{body}</section>")


def _row(s: ObjectSummary, errors: dict[int, float]) -> list[str]:
    cells = [chip(s.object_id), s.class_name, str(s.n_seen), str(s.n_moving)]
    cells.append(f"{s.median_kmh:.1f}")
    cells.append(f"{s.top_kmh:.1f} ± {s.top_std_kmh:.1f}")
    cells.append(f"{s.way_m:.1f}")
    if errors:
        error = errors.get(s.object_id)
        cells.append("" if error is None else f"{error:.2f}")
    return cells


def _errors_kmh(result: Result) -> dict[int, float]:
    """Mean error of the speed by own id, where the truth is known."""
    per_object = result.metrics.get("objects", {}).get("per_object", {})
    return {
        int(own): float(entry["speed_abs_mean_kmh"])
        for entry in per_object.values()
        if entry.get("speed_abs_mean_kmh") is not None
        for own in entry["estimated_ids"]
    }
