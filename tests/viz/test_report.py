"""report.html: complete, self-contained, and at home with results that lack most things."""

import re
from html import unescape
from pathlib import Path

import numpy as np
import pytest

import viz.report
from pipelines.config import Config
from pipelines.evaluation import evaluate_result
from pipelines.geometry import exp_se3, make_T
from pipelines.io.config import config_to_dict
from pipelines.io.folder import clear_result_folder
from pipelines.io.result import ResultWriter, load_result
from pipelines.object_types import ObjectEstimates
from pipelines.types import GroundTruth, ObjectTruth, StaticMap
from tests.frame_results import frame_result
from viz import style
from viz.overlay import write_image
from viz.playback import build_playback
from viz.plots import PLOTS, plot_result
from viz.render import VIEW_NAMES
from viz.report import write_report
from viz.report_objects import summarise_objects

N = 12
STEP = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))  # of the car: 36 km/h at 10 frames/s


def two_objects() -> ObjectEstimates:
    """Car 1 drives, its speed differing by frame; car 2 stands."""
    keys = [(k, j) for k in range(N) for j in (1, 2)]
    index, ids = np.array(keys).T
    drives = ids == 1
    start = make_T(np.eye(3), np.array([2.0, 1.0, 8.0]))
    T = np.array([
        np.linalg.matrix_power(STEP, k) @ start if j == 1 else make_T(np.eye(3), np.full(3, 9.0))
        for k, j in keys
    ])  # fmt: skip
    H = np.array([STEP if moves else np.eye(4) for moves in drives])
    speed = np.where(drives, 10.0 + 0.1 * index, 0.0)
    M = len(keys)
    return ObjectEstimates(
        index, 0.1 * index, ids, np.full(M, "car"), np.ones(M),
        np.where(drives, "moving", "stopped"), np.tile([10.0, 10, 60, 60], (M, 1)),
        np.full(M, 50), T, H, np.full((M, 6, 6), np.nan), T[:, :3, 3], speed, np.full(M, 0.25),
        np.outer(speed, [0, 0, 1]), np.full(M, 0.2), np.full((M, 3), 1.5),
    )  # fmt: skip


def write(folder: Path, *, whole: bool = True, name: str = "a street") -> Path:
    """A result of a run; with truth, objects, settings, pictures and metrics where it is whole."""
    objects = two_objects()
    Ts = np.array([make_T(np.eye(3), np.array([0.0, 0.0, 0.5 * k])) for k in range(N)])
    results = [
        frame_result(
            k,
            Ts[k],
            objects=objects[objects.frame_index == k] if whole else ObjectEstimates.empty(),
            timings_ms={"flow": 4.0, "total": 12.0},
        )
        for k in range(N)
    ]
    writer = ResultWriter(folder)
    writer.write_camera(results)
    if not whole:
        return folder
    points = np.random.default_rng(0).uniform([-4, -2, 4], [4, 2, 20], (300, 3))
    colors = np.full((300, 3), 120, np.uint8)
    writer.write_run(
        results,
        StaticMap(points, colors, np.ones(300, np.int32), Ts[:1], np.zeros(1, np.int64)),
        GroundTruth(
            0.1 * np.arange(N),
            Ts,
            ObjectTruth(
                objects.frame_index, objects.object_id, objects.class_name,
                objects.Ts_world_object, objects.boxes_px, objects.object_id == 1,
            ),
        ),
    )  # fmt: skip
    settings = config_to_dict(Config())
    settings["orb"]["n_features"] = 777
    writer.write_config(settings)
    (folder / "run.log").write_text("", encoding="utf-8")
    run = {"sequence": name, "dataset": "simulated", "frames": N, "tracked": N, "lost": 0}
    writer.write_metrics({"run": {**run, "interrupted": False}}, "")
    evaluate_result(folder)
    (folder / "frames").mkdir()
    for k in range(0, N, 2):
        write_image(folder / f"frames/{k:06d}.png", np.full((60, 200, 3), 20 * k, np.uint8))
    return folder


@pytest.fixture
def scene(monkeypatch) -> str:
    """A small page in the place of the scene, whose own tests are elsewhere."""
    import viz.browser

    page = '<!doctype html><p id="inner">The "scene" & all</p>'
    monkeypatch.setattr(viz.browser, "scene_html", lambda result, **options: page)
    return page


def words(page: str) -> str:
    without = re.sub(r"<style>.*?</style>|srcdoc=\"[^\"]*\"", "", page, flags=re.DOTALL)
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", without)).split())


def test_the_page_tells_what_the_folder_holds(tmp_path, scene):
    folder = write(tmp_path / "result")
    plots = plot_result(folder)
    path = write_report(load_result(folder))
    assert path == folder / "report.html"
    page = path.read_text(encoding="utf-8")
    text = words(page)
    assert text.startswith(
        "a street · DyOb-SLAM a street DyOb-SLAM · simulated In motion: 1 car at"
    )
    for part in ("12 of 12 frames tracked", "5.5 m camera's way in 1.1 s", "300 points",
                 "ATE, SE(3) aligned", "Objects in motion", "No global batch was run"):  # fmt: skip
        assert part in text, part
    # The car's row: seen, moving, median and largest speed, its way, and the error of its speed
    assert re.search(r"1 car 12 12 38\.0 40\.0 ± 0\.9 11\.0 \d\.\d\d", text)
    assert "1 that were not seen moving" in text and "orb.n_features 777 1500" in text
    assert style.hex_color(style.object_color(1)) in page
    assert page.count("<img ") == len(plots) + viz.report.N_FRAMES
    assert "camera_tum.txt" in text and "the camera's poses" in text
    for link in re.findall(r'<a href="([^"]+)"', page):
        assert (folder / link).exists(), link
    assert 'srcdoc="&lt;!doctype html&gt;&lt;p id=&quot;inner&quot;&gt;' in page


def test_each_picture_that_is_made_has_its_words():
    assert set(viz.report.CAPTIONS) == {*PLOTS, *(f"map_{name}" for name in VIEW_NAMES)}


def test_nothing_comes_from_outside(tmp_path, scene):
    folder = write(tmp_path / "result")
    plot_result(folder)
    page = write_report(load_result(folder)).read_text(encoding="utf-8")
    assert all(uri.startswith("data:image/") for uri in re.findall(r'src="([^"]*)"', page))
    assert not re.search(r"https?://|@import|url\(", page)
    assert len(page) < viz.report.LARGEST_BYTES


def test_a_bare_trajectory_has_a_page_that_says_what_is_missing(tmp_path, scene):
    text = words(write_report(load_result(write(tmp_path / "bare", whole=False))).read_text())
    for part in ("Unfinished", "12 of 12 frames tracked", "no ground truth", "No objects",
                 "The run has left none"):  # fmt: skip
        assert part in text, part
    for part in ("Global batch", "Diagrams", "Time a frame", "nan"):
        assert part not in text, part


def test_a_run_without_one_pose_has_a_page(tmp_path, scene):
    folder = write(tmp_path / "lost", whole=False)
    (folder / "camera_tum.txt").write_text("# time x y z qx qy qz qw\n", encoding="utf-8")
    assert "0 of 0 frames tracked" in words(write_report(load_result(folder)).read_text())


def test_an_interrupted_run_and_a_strange_name_are_told(tmp_path, scene):
    folder = write(tmp_path / "result", name='<b>"street" & co')
    metrics = load_result(folder).metrics
    metrics["run"]["interrupted"] = True
    ResultWriter(folder).write_metrics(metrics, "")
    page = write_report(load_result(folder)).read_text(encoding="utf-8")
    assert "Stopped before its end" in page
    assert "<b>" not in page and "&lt;b&gt;&quot;street&quot; &amp; co" in page


def test_a_scene_too_large_for_the_page_lies_beside_it(tmp_path, scene, monkeypatch):
    folder = write(tmp_path / "result")
    monkeypatch.setattr(viz.report, "LARGEST_BYTES", 1000)
    page = write_report(load_result(folder)).read_text(encoding="utf-8")
    assert "<iframe" not in page and '<a href="scene.html">' in page
    assert (folder / "scene.html").read_text(encoding="utf-8") == scene
    clear_result_folder(folder)
    assert not (folder / "scene.html").exists() and not (folder / "report.html").exists()


def test_frames_of_before_the_batch_are_said_to_be_so(tmp_path, scene):
    folder = write(tmp_path / "result")
    assert "known live" not in words(write_report(load_result(folder)).read_text())
    metrics = load_result(folder).metrics
    ResultWriter(folder).write_metrics({**metrics, "batch": {"accepted": True}}, "")
    assert "known live" in words(write_report(load_result(folder)).read_text())


def test_an_object_is_summed_up(tmp_path):
    result = load_result(write(tmp_path / "result"))
    car, parked = summarise_objects(result, build_playback(result))
    assert (car.object_id, car.n_seen, car.n_moving, parked.n_moving) == (1, N, N, 0)
    assert car.top_kmh == pytest.approx(3.6 * 11.1, abs=1e-3)
    assert car.median_kmh == pytest.approx(3.6 * 10.55, abs=1e-3)
    assert car.top_std_kmh == pytest.approx(0.9, abs=1e-3)
    assert car.way_m == pytest.approx(11.0, abs=1e-3) and parked.way_m == 0.0


def test_a_browser_shows_it_on_a_desk_and_on_a_phone(tmp_path, browser):
    """With the scene itself inside: no error, nothing asked of the network, nothing cut off."""
    folder = write(tmp_path / "result")
    plot_result(folder)
    path = write_report(load_result(folder))
    said, asked = [], []
    context = browser.new_context()
    page = context.new_page()
    page.on("console", lambda message: said.append((message.type, message.text)))
    page.on("pageerror", lambda error: said.append(("error", str(error))))
    page.on("request", lambda request: asked.append(request.url))
    for width in (1280, 390):
        page.set_viewport_size({"width": width, "height": 900})
        page.goto(path.as_uri())
        page.wait_for_timeout(500)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    backgrounds = []
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        backgrounds.append(page.evaluate("getComputedStyle(document.body).backgroundColor"))
    page.emulate_media(media="print")
    assert not page.locator(".scene").is_visible()
    context.close()
    assert not [text for kind, text in said if kind == "error"]
    assert {url for url in asked if not url.startswith(("data:", "blob:", "about:"))} == {
        path.as_uri()
    }
    assert backgrounds[0] != backgrounds[1]
