"""Paths of moving objects on maps: whose, where they break, and the tags at their ends."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.io.result import Result
from pipelines.object_types import ObjectEstimates
from pipelines.types import ObjectTruth
from viz import style
from viz.lines import draw_polyline
from viz.object_marks import overlaps
from viz.object_paths import object_paths, true_object_paths
from viz.scene import build_scene
from viz.tags import draw_ends, draw_tags
from viz.views import choose_view

SIZE = (1280, 720)


def make_objects(tracks: dict[int, np.ndarray], state: str = "moving") -> ObjectEstimates:
    """Centres (N, 3) by id, a frame each 0.1 s; NaN where the object is not seen."""
    keys = [(j, k) for j, t in tracks.items() for k in range(len(t)) if np.isfinite(t[k]).all()]
    M, T = len(keys), np.tile(np.eye(4), (len(keys), 1, 1))
    T[:, :3, 3] = np.reshape([tracks[j][k] for j, k in keys], (-1, 3))
    index, blank = np.array([k for _, k in keys]), np.full(M, np.nan)
    return ObjectEstimates(
        index, 0.1 * index, np.array([j for j, _ in keys]), np.full(M, "car"), np.ones(M),
        np.full(M, state), np.full((M, 4), np.nan), np.full(M, 9), T, T, np.zeros((M, 6, 6)),
        np.array([tracks[j][k] for j, k in keys]), np.full(M, 12.0), blank,
        np.full((M, 3), np.nan), blank, np.full((M, 3), np.nan),
    )  # fmt: skip


def line(n: int, x: float = 0.0) -> np.ndarray:
    return np.stack([np.full(n, x), np.zeros(n), np.arange(n, dtype=float)], 1)


def make_result(objects: ObjectEstimates) -> Result:
    Ts = np.tile(np.eye(4), (40, 1, 1))
    Ts[:, 2, 3] = np.arange(40)
    stamps, none = 0.1 * np.arange(40), np.empty((0, 3))
    return Result(Path("run"), stamps, Ts, None, None, none, none.astype(np.uint8), objects=objects)


def test_moving_objects_leave_paths_in_their_colors():
    hidden = line(30, 2.0)
    hidden[10:12] = np.nan  # briefly
    hidden[18:27] = np.nan  # for long
    tracks = {1: line(30), 2: hidden, 3: line(4, 4.0), 4: 0.01 * line(30)}
    lines, tags = object_paths(make_objects(tracks))
    assert [len(piece.points_m) for piece in lines] == [30, 16, 3]
    assert [piece.color for piece in lines] == [style.object_color(j) for j in (1, 2, 2)]
    assert [tag.text for tag in tags] == ["1 car 43 km/h", "2 car 43 km/h"]
    np.testing.assert_allclose(tags[0].point_m, [0.0, 0.0, 29.0])
    assert object_paths(make_objects(tracks, "stopped")) == ([], [])
    assert object_paths(ObjectEstimates.empty()) == ([], [])


def test_a_path_is_that_of_matter_and_not_of_what_is_seen_of_it():
    objects = make_objects({1: line(30)})
    grown = np.linspace(1.0, 0.0, 30)[:, None] * (0.5, 0.0, -1.5)  # from its rear to its middle
    objects = replace(objects, centers_m=objects.centers_m + grown)
    (path,), _ = object_paths(objects)
    np.testing.assert_allclose(path.points_m, line(30), atol=1e-9)
    unknown = replace(objects, Ts_world_object=np.full((30, 4, 4), np.nan))
    (path,), _ = object_paths(unknown)
    np.testing.assert_allclose(path.points_m, objects.centers_m)


def test_the_camera_path_lies_over_those_of_objects():
    labels = [p.label for p in build_scene(make_result(make_objects({1: line(30)}))).polylines]
    assert labels[0] == "moving objects"
    assert labels[-1] == "camera, estimated"


def test_tags_are_drawn_beside_discs_and_never_over_each_other():
    tracks = {j: line(30, 0.3 * j) for j in range(1, 9)}  # ends close together
    scene = build_scene(make_result(make_objects(tracks)))
    view = choose_view("top", scene, SIZE)
    picture = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    draw_tags(picture, view, scene, [])
    for tag in scene.tags[-1:]:
        u, v = view.project(tag.point_m[None])[0][0].round().astype(int)
        assert (picture[v, u] == tag.color).all()
    blocked = np.full_like(picture, 255)
    draw_tags(blocked, view, scene, [(0, 0, *SIZE)])  # no room at all: discs alone
    dark = (picture.astype(int).sum(2) < 250).sum()
    assert dark > 400
    assert (blocked.astype(int).sum(2) < 250).sum() < 0.1 * dark
    assert overlaps((0, 0, 2, 2), [(1, 1, 3, 3)])
    assert not overlaps((0, 0, 2, 2), [(2, 0, 3, 2)])


def test_true_objects_that_move_have_paths_with_gaps():
    hidden = line(20, 3.0)
    hidden[8:12] = np.nan
    index, ids = np.tile(np.arange(20), 2), np.repeat([4, 9], 20)
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, 3] = np.concatenate([hidden, line(20, 5.0)])
    moving = (ids == 4) & (index > 14)  # it stood at first; 9 stands all the time
    truth = ObjectTruth(index, ids, np.full(40, "car"), T, np.full((40, 4), np.nan), moving)
    before, after = true_object_paths(truth)
    np.testing.assert_array_equal(before, hidden[:8])
    np.testing.assert_array_equal(after, hidden[12:])


def test_words_at_the_ends_of_the_path_hide_no_other_path():
    """They stand below, but above where a car drives close below the camera."""
    for sides, is_above in (((0.9,), True), ((-5.0,), False)):
        result = make_result(make_objects({j + 1: line(40, x) for j, x in enumerate(sides)}))
        scene = build_scene(result)
        view = choose_view("top", scene, SIZE)
        picture = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
        for path in scene.polylines:
            draw_polyline(picture, view, path)
        bare = picture.copy()
        taken = draw_ends(picture, view, scene, [])
        v_end = view.project(scene.path_m[-1:])[0][0, 1]
        end, start = taken[2:]
        assert (end[3] < v_end, start[3] < v_end) == (is_above, is_above)
        for j in range(len(sides)):
            of_car = (bare == style.object_color(j + 1)).all(2)
            assert of_car.any() and (picture[of_car] == style.object_color(j + 1)).all()


def test_words_at_the_ends_of_the_path_lie_off_discs_that_come_later():
    ahead = line(50)
    ahead[:40] = np.nan
    tracks = {1: line(40, 0.9), 2: line(40, -0.9), 3: ahead}  # so that all words hide some path
    scene = build_scene(make_result(make_objects(tracks)))
    view = choose_view("top", scene, SIZE)
    taken = draw_ends(np.full((SIZE[1], SIZE[0], 3), 255, np.uint8), view, scene, [])
    for tag in scene.tags:
        (u, v), _ = (values[0] for values in view.project(tag.point_m[None]))
        for left, top, right, bottom in taken[2:]:
            assert not (left < u < right and top < v < bottom)
