"""One frame over the map: boxes where their objects are, in their colours, labels that keep off."""

from dataclasses import replace

import numpy as np
import pytest

from viz import style
from viz.box_marks import draw_box_labels, draw_boxes
from viz.chase import chase_views
from viz.moment import build_stage, draw_moment
from viz.playback import build_playback
from viz.views import choose_view

SIZE = (640, 360)
COLOR = np.array(style.object_color(3))


def blank() -> np.ndarray:
    return np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)


def inked(picture: np.ndarray, color: np.ndarray = COLOR) -> np.ndarray:
    return np.abs(picture.astype(int) - color).sum(2) < 60


def box_and_view(run, k: int = 4, state: str = "moving"):
    objects = replace(run.objects, state=np.full(len(run.objects), state))
    playback = build_playback(replace(run, objects=objects))
    return playback.boxes[k], chase_views(playback, SIZE)[k]


def test_a_box_is_drawn_where_its_corners_are(short_run):
    boxes, view = box_and_view(short_run)
    picture = blank()
    draw_boxes(picture, view, boxes)
    v, u = np.nonzero((picture != 255).any(2))
    uv, _ = view.project(boxes[0].corners_m)
    np.testing.assert_allclose([u.min(), v.min()], uv.min(0), atol=3)
    np.testing.assert_allclose([u.max(), v.max()], uv.max(0), atol=3)


def test_what_moves_stands_out_and_its_front_shows_where_to(short_run):
    shares = {}
    for state in ("moving", "coasting", "stopped"):
        boxes, view = box_and_view(short_run, state=state)
        picture = blank()
        draw_boxes(picture, view, boxes)
        shares[state] = (255.0 - picture).sum()
        if state == "moving":
            uv, _ = view.project(boxes[0].corners_m)
            front = picture[tuple(uv[[1, 3, 5, 7]].mean(0).astype(int)[::-1])]
            side = picture[tuple(uv[[0, 2, 4, 6]].mean(0).astype(int)[::-1])]
            assert np.abs(front.astype(int) - COLOR).sum() < np.abs(side.astype(int) - COLOR).sum()
    assert shares["moving"] > 2 * shares["stopped"] > shares["coasting"] > 0


def test_labels_keep_off_what_is_taken(short_run):
    boxes, view = box_and_view(short_run)
    free, crowded = blank(), blank()
    draw_box_labels(free, view, boxes, [], 14)
    v, u = np.nonzero(inked(free))
    place = (int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1)
    assert 14 < place[3] - place[1] < 30
    draw_box_labels(crowded, view, boxes, [place], 14)
    assert inked(crowded).any()
    assert not inked(crowded)[place[1] : place[3], place[0] : place[2]].any()
    full = blank()
    draw_box_labels(full, view, boxes, [(0, 0, *SIZE)], 14)
    assert (full == 255).all()


def test_a_box_behind_the_view_is_not_drawn(short_run):
    boxes, view = box_and_view(short_run)
    T_behind = boxes[0].T_world_box.copy()
    T_behind[2, 3] = -30.0
    behind = [replace(boxes[0], T_world_box=T_behind)]
    picture = blank()
    draw_boxes(picture, view, behind)
    draw_box_labels(picture, view, behind, [], 14)
    assert (picture == 255).all()


@pytest.mark.parametrize("dark", [False, True])
def test_paths_go_as_far_as_the_frame(short_run, dark):
    playback = build_playback(short_run)
    stage = build_stage(playback)
    view = choose_view("top", playback.scene, SIZE)
    ink = []
    for k in (2, 7):
        picture = blank()
        picture[:] = style.BACKGROUNDS["black" if dark else "white"]
        draw_moment(picture, view, stage, k, dark=dark)
        color = style.on_dark(style.ESTIMATE) if dark else style.ESTIMATE
        ink.append(inked(picture, np.array(color)))
    early, late = (np.nonzero(mask)[1].max() for mask in ink)
    assert late - early == pytest.approx(5 * 0.5 * view.px_per_m, abs=4)  # to the right
