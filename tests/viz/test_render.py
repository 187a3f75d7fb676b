"""Map pictures of a result folder, by both renderers, and their legend, lines and scale bar."""

import cv2
import numpy as np
import pytest

from pipelines.errors import DyObError, FormatError
from pipelines.geometry import exp_se3
from pipelines.io.result import ResultWriter, load_result
from pipelines.types import GroundTruth, StaticMap
from tests.frame_results import frame_result
from viz import offscreen, style
from viz.figures import digits
from viz.legend import scale_bar_m
from viz.lines import draw_polyline
from viz.render import render_result
from viz.scene import Polyline, View, build_scene
from viz.views import choose_view

SIZE = (640, 360)
STEP = exp_se3(np.array([0.0, 0.01, 0.0, 0.0, 0.0, 1.0]))
POINT_COLOR = (20, 120, 60)


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    Ts = np.array([np.linalg.matrix_power(STEP, k) for k in range(40)])
    results = [frame_result(k, T) for k, T in enumerate(Ts)]
    sides = rng.choice([-6.0, 6.0], 1500)
    points = np.stack([sides, rng.uniform(-2, 1, 1500), rng.uniform(0, 40, 1500)], 1)
    colors = np.tile(np.uint8(POINT_COLOR), (1500, 1))
    n, none = np.ones(1500, np.int32), np.empty(0, np.int64)
    writer = ResultWriter(tmp_path)
    static_map = StaticMap(points, colors, n, np.empty((0, 4, 4)), none)
    writer.write_run(results, static_map, GroundTruth(np.arange(40) * 0.1, Ts))
    return tmp_path


def read(path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture[..., ::-1]


def share_of(picture: np.ndarray, color: style.Color, tolerance: int = 40) -> float:
    return float((np.abs(picture.astype(int) - color).sum(2) < tolerance).mean())


NAMES = ("map_top", "static_top", "map_iso", "static_iso", "map_chase")


def check_pictures(folder, renderer):
    paths = render_result(folder, size=SIZE, renderer=renderer)
    assert [path.stem for path in paths] == list(NAMES)
    scene = build_scene(load_result(folder))
    shown = tuple(round(0.82 * c) for c in POINT_COLOR)
    for path in paths:
        picture = read(path)
        assert picture.shape == (SIZE[1], SIZE[0], 3)
        assert 0.5 < share_of(picture, (255, 255, 255), 1) < 0.99  # white, not cream
        kind, name = path.stem.split("_")
        assert (share_of(picture, style.ESTIMATE) > 5e-4) == (kind == "map")
        has_truth = kind == "map" and name != "chase"
        assert (share_of(picture, style.TRUTH, 6) > 5e-4) == has_truth  # grey, as edges of letters
        assert share_of(picture, shown) > (2e-3 if name == "top" else 2e-4)  # the rest has haze
        if name == "chase":
            continue
        # Points are where the view says that they are.
        uv, _ = choose_view(name, scene, SIZE).project(scene.points_m)
        u, v = np.round(uv).astype(int).T
        free = (u >= 0) & (u < SIZE[0]) & (v >= 100) & (v < SIZE[1] - 90)
        hit = picture[v[free], u[free]].astype(int)
        assert (np.abs(hit - 255).sum(1) > 60).mean() > 0.9


def test_chase_is_of_the_frame_asked_for(folder):
    early, late = (
        read(*render_result(folder, size=SIZE, views=("chase",), frame=k, renderer="splat"))
        for k in (3, 30)
    )
    assert (early != late).any(2).mean() > 0.02
    with pytest.raises(DyObError, match="expected a frame of this run, 0 to 39, found 99"):
        render_result(folder, size=SIZE, views=("chase",), frame=99, renderer="splat")


def test_pictures_by_the_software_renderer(folder):
    check_pictures(folder, "splat")


def test_pictures_by_open3d(folder):
    view = View("probe", (16, 16), np.diag([8.0, 8.0, 1.0]), np.eye(4))
    one = np.array([[0.0, 0.0, 1.0]])
    if not list(offscreen.render_points([view], one, np.uint8(one * 0), 0.1, (9, 9, 9))):
        pytest.skip("needs a Vulkan driver (Debian: libvulkan1 mesa-vulkan-drivers)")
    check_pictures(folder, "open3d")


def test_without_vulkan_the_software_renderer_takes_over(folder, monkeypatch, caplog):
    monkeypatch.setattr(offscreen.sys, "executable", "/bin/false")
    check_pictures(folder, "auto")
    assert "Open3D cannot render here" in caplog.text


def test_dark_background(folder):
    paths = render_result(folder, size=SIZE, views=("top",), background="black", renderer="splat")
    assert [path.stem for path in paths] == ["map_top", "static_top"]
    picture = read(paths[0])
    assert np.median(picture) < 30
    assert share_of(picture, (90, 180, 255)) > 5e-4


@pytest.mark.parametrize("renderer", ["open3d", "splat"])
def test_the_dark_ground_is_the_same_by_every_renderer(folder, renderer, caplog):
    path = render_result(folder, size=SIZE, background="black", renderer=renderer, views=("iso",))[
        0
    ]
    if "Open3D cannot render" in caplog.text:
        pytest.skip("no Vulkan driver on this machine")
    assert share_of(read(path), style.BACKGROUNDS["black"], 4) > 0.5


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.0, "0.00"), (0.0000924, "0.000092"), (0.0598, "0.0598"), (3.274, "3.27"), (512.3, "512")],
)
def test_small_errors_keep_their_digits(value, words):
    assert digits(value) == words


def test_a_run_with_nothing_in_it_still_has_pictures(tmp_path):
    ResultWriter(tmp_path).write_camera([])
    for path in render_result(tmp_path, size=(320, 180), renderer="splat"):
        assert read(path).shape == (180, 320, 3)


@pytest.mark.parametrize("wrong", [{"background": "pink"}, {"renderer": "x"}, {"views": ("side",)}])
def test_unknown_names(folder, wrong):
    with pytest.raises(ValueError, match="expected"):
        render_result(folder, size=SIZE, **{"renderer": "splat", **wrong})


def test_no_result_folder(tmp_path):
    with pytest.raises(FormatError, match="expected a result folder"):
        render_result(tmp_path / "gone")


@pytest.mark.parametrize(
    ("px_per_m", "expected"), [(10.0, 20.0), (1.0, 200.0), (200.0, 1.0), (700.0, 0.2), (0.2, 1000)]
)
def test_scale_bar_is_round(px_per_m, expected):
    assert scale_bar_m(px_per_m, 240.0) == pytest.approx(expected)


def test_lines_are_cut_behind_the_view():
    view = View(
        "t", (100, 80), np.array([[50.0, 0, 49.5], [0, 50.0, 39.5], [0, 0, 1.0]]), np.eye(4)
    )
    picture = np.full((80, 100, 3), 255, np.uint8)
    line = Polyline(np.array([[1.0, 0.5, 2.0], [1.0, 0.5, -2.0]]), (200, 0, 0), 2.0)
    draw_polyline(picture, view, line)
    v, u = np.nonzero((picture < 255).any(2))
    assert len(u) > 10
    assert u.min() >= 72  # from (74.5, 52) outwards; nothing of the part behind
    assert v.min() >= 50


def test_lines_go_through_their_pixels():
    view = View(
        "t", (100, 80), np.array([[50.0, 0, 49.5], [0, 50.0, 39.5], [0, 0, 1.0]]), np.eye(4)
    )
    picture = np.full((80, 100, 3), 255, np.uint8)
    line = Polyline(np.array([[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]), (0, 0, 250), 2.0)
    draw_polyline(picture, view, line)
    v, u = np.nonzero((picture < 200).any(2))
    assert set(v) <= {38, 39, 40, 41}
    assert abs(u.min() - 24) <= 2
    assert abs(u.max() - 75) <= 2
