"""The pages in a real browser: they open in peace, the slider moves objects, nothing leaks out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pipelines.config import Config
from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.geometry import exp_se3, transform_points
from pipelines.types import Frame, FrameResult, MotionHypothesis, TrackingStatus
from viz.browser import export_scene
from viz.browser.live import LiveViewer
from viz.browser.recorded import RecordedServer
from viz.scene import level_axes

SIZE = {"width": 900, "height": 560}
WAIT_S = 40.0


class Visit:
    """A page in the browser, what it complained of, and what it asked for."""

    def __init__(self, browser: Any, address: str) -> None:
        self.context = browser.new_context(viewport=SIZE)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.context.route("**/*", self._asked)
        self.page.goto(address)
        self.until("!!(window.dyob && dyob.ready)")

    def _heard(self, message: Any) -> None:
        # Drivers in software tell how slow they are.
        if message.type in ("error", "warning") and "GPU stall" not in message.text:
            self.complaints.append(message.text)

    def _asked(self, route: Any) -> None:
        self.requests.append(route.request.url)
        route.continue_()

    def ask(self, script: str) -> Any:
        return self.page.evaluate(script)

    def until(self, condition: str) -> None:
        deadline = time.monotonic() + WAIT_S
        while not self.ask(condition):  # the page's policy forbids playwright's own waiting
            assert time.monotonic() < deadline, f"{condition}: {self.complaints}"
            self.page.wait_for_timeout(50)

    def picture(self) -> np.ndarray:
        self.page.wait_for_timeout(250)
        return cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)

    def box(self, object_id: int) -> dict[str, Any]:
        (found,) = [box for box in self.ask("dyob.boxes()") if box["id"] == object_id]
        return found

    def slide_to(self, k: int) -> None:
        """As a person does: the slider's own event."""
        self.ask(
            f"(() => {{ const s = document.getElementById('slider'); s.value = {k}; "
            "s.dispatchEvent(new Event('input')); })()"
        )


@pytest.fixture(scope="module")
def scene(browser, result, tmp_path_factory) -> Iterator[Visit]:
    path = export_scene(result, tmp_path_factory.mktemp("page") / "scene.html")
    visit = Visit(browser, path.as_uri())
    yield visit
    visit.context.close()


def around(picture: np.ndarray, pixel: list[float]) -> np.ndarray:
    u, v = round(pixel[0]), round(pixel[1])
    return picture[max(v - 15, 0) : v + 15, max(u - 20, 0) : u + 20].astype(float)


def test_the_page_alone_shows_the_run_and_asks_for_nothing(scene):
    assert scene.ask("dyob.length") == 8
    assert scene.ask("document.title") == "a <b>road</b> - DyOb-SLAM"
    assert scene.ask("document.getElementById('points').textContent") == "600 points"
    assert {box["id"] for box in scene.ask("dyob.boxes()")} == {3, 5}
    assert scene.picture().std() > 5
    assert all(url.startswith(("file:", "data:")) for url in scene.requests)
    assert scene.complaints == []


def test_the_slider_moves_the_objects(scene, objects):
    scene.ask("dyob.view('top')")
    scene.slide_to(1)
    before, first = scene.box(3), scene.picture()
    scene.slide_to(7)
    after, second = scene.box(3), scene.picture()
    centers = objects.centers_m[objects.object_id == 3]
    np.testing.assert_allclose(before["position"], centers[1], atol=2e-3)
    np.testing.assert_allclose(after["position"], centers[7], atol=2e-3)
    for place in (before["pixel"], after["pixel"]):
        assert np.abs(around(first, place) - around(second, place)).mean() > 10
    parked = scene.box(5)
    np.testing.assert_allclose(parked["position"], [-3, 0.8, 8], atol=2e-3)
    assert scene.ask("document.getElementById('count').textContent") == "frame 7"
    assert scene.complaints == []


def test_up_is_up_and_right_is_right(scene):
    scene.ask("dyob.view('follow')")
    scene.ask("dyob.seek(0)")
    moving, parked = scene.box(3)["pixel"], scene.box(5)["pixel"]
    assert parked[0] < 450 < moving[0]
    camera = scene.ask("dyob.player.viewer.camera.position.toArray()")
    assert camera[1] > 1.0  # three's up: the view is from above the car's camera, and from behind
    assert camera[2] > 1.0
    label, other = scene.ask("dyob.labels()")
    assert label["words"] == "3 car 29 km/h" and other["words"] == "5 car stopped"
    assert label["bottom"] < moving[1]


def test_layers_are_hidden_and_shown(scene):
    scene.ask("dyob.view('top')")
    scene.slide_to(3)
    whole = scene.picture()
    for layer in ("objects", "trails", "camera", "labels", "image"):
        scene.page.click(f"#show-{layer}")
        less = scene.picture()
        assert np.abs(whole.astype(float) - less).max() > 60, layer
        scene.page.click(f"#show-{layer}")
    assert np.abs(whole.astype(float) - scene.picture()).mean() < 0.5


def test_the_truth_is_hidden_until_it_is_asked_for(scene):
    scene.ask("dyob.view('top')")
    scene.slide_to(7)
    assert not scene.page.is_checked("#show-truth")
    without = scene.picture().astype(float)
    scene.page.click("#show-truth")
    shown = np.abs(scene.picture() - without).max(2) > 40
    scene.page.click("#show-truth")
    assert np.abs(scene.picture() - without).mean() < 0.5
    # The true car's way is a line of grey 1.5 m beside the estimated one, along all of it.
    car = [scene.ask(f"(dyob.seek({k}), dyob.boxes().find((b) => b.id === 3))") for k in (0, 7)]
    for place in car:
        x, y, z = place["position"]
        beside = f"new MeshCat.THREE.Vector3({x + 1.5}, {y}, {z})"
        u, v, _ = scene.ask(f"dyob.player.labels.project({beside})")
        assert around(shown, [u, v]).any()
    assert len(scene.ask("dyob.player.about.truth")) == 2  # the camera, and what moves


def test_from_above_what_is_ahead_is_to_the_right(scene):
    scene.ask("dyob.view('top')")
    scene.ask("dyob.seek(0)")
    before, parked = scene.box(3)["pixel"], scene.box(5)["pixel"]
    scene.ask("dyob.seek(7)")
    after = scene.box(3)["pixel"]
    assert after[0] > before[0] + 40
    assert parked[1] < before[1]  # it is at the left of the street
    scene.page.set_viewport_size({"width": 390, "height": 760})
    scene.until("dyob.player.viewer.camera.aspect < 1")
    scene.ask("dyob.view('top')")
    assert scene.box(3)["pixel"][1] < scene.box(5)["pixel"][1]  # on a phone, ahead is upward
    head, picture = (scene.page.locator(name).bounding_box() for name in ("#head", "#picture"))
    assert head["y"] + head["height"] <= picture["y"]
    scene.page.set_viewport_size(SIZE)
    scene.until("dyob.player.viewer.camera.aspect > 1")


@pytest.mark.parametrize("size", [SIZE, {"width": 390, "height": 760}])
def test_views_of_the_whole_lie_between_the_panels(scene, size):
    scene.page.set_viewport_size(size)
    scene.until(f"dyob.player.labels.width === {size['width']}")  # laid out anew
    head, picture, controls = (
        scene.page.locator(name).bounding_box() for name in ("#head", "#picture", "#controls")
    )
    for view in ("top", "free"):
        scene.ask(f"dyob.view('{view}')")
        places = scene.ask("dyob.player.frames.list.map((f) => dyob.player.labels.project(f.p))")
        for k in range(8):
            places += [box["pixel"] for box in scene.ask(f"(dyob.seek({k}), dyob.boxes())")]
        for u, v, *_ in places:
            assert 0 < u < size["width"]
            assert head["y"] + head["height"] < v < controls["y"]
            beside = u < picture["x"] or v > picture["y"] + picture["height"]
            assert beside, (view, u, v)
    scene.page.set_viewport_size(SIZE)
    scene.until("dyob.player.viewer.camera.aspect > 1")


def test_a_picture_of_before_the_batch_says_so(scene):
    scene.slide_to(2)
    assert "before the global batch" in scene.page.inner_text("#caption")


def test_keys_step_and_play_goes_on_by_itself(scene):
    scene.slide_to(2)
    scene.page.keyboard.press("ArrowRight")
    assert scene.ask("dyob.frame") == 3
    scene.page.keyboard.press("ArrowLeft")
    scene.page.keyboard.press("ArrowLeft")
    assert scene.ask("dyob.frame") == 1
    scene.page.keyboard.press("2")
    assert scene.ask("dyob.player.views.mode") == "top"
    scene.page.keyboard.press("Space")
    scene.until("dyob.frame === 7 && !dyob.player.playing")
    scene.page.keyboard.press("t")
    scene.page.keyboard.press("i")
    assert scene.ask("document.body.dataset.theme") == "light"
    assert scene.complaints == []


def test_a_result_is_seen_through_its_server(browser, result, capfd):
    server = RecordedServer(result, host="0.0.0.0")
    server.start()
    own = f"http://127.0.0.1:{server.port}/"
    try:
        visit = Visit(browser, f"{own}?token={server.token}")
        visit.slide_to(6)
        assert visit.box(3)["position"][2] > 13
        visit.until("document.getElementById('frame').naturalWidth === 320")
        assert all(url.startswith((own, "data:")) for url in visit.requests)
        assert any("picture/6" in url for url in visit.requests)
        assert visit.complaints == []
        visit.context.close()
    finally:
        server.stop()
    assert "Traceback" not in capfd.readouterr().err


def live_frames(objects, n: int) -> Iterator[tuple[Frame, FrameResult]]:
    for k in range(n):
        frame = Frame(k, 0.1 * k, np.full((120, 320, 3), 40 + 20 * k, np.uint8))
        T = np.eye(4)
        T[2, 3] = 0.4 * k
        yield (
            frame,
            FrameResult(
                k, 0.1 * k, TrackingStatus.OK, T, np.zeros((6, 6)),
                MotionHypothesis.CONSTANT_VELOCITY, k == 0, np.empty((0, 2)),
                np.empty(0, np.int64), np.empty(0, bool), 0.1,
                objects[objects.frame_index == k],
                np.zeros((120, 320), np.int32),
            ),
        )  # fmt: skip


def test_a_live_run_is_seen_and_stays_when_it_is_over(browser, objects, tmp_path, capfd):
    urls: list[str] = []
    viewer = LiveViewer(announce=urls.append)
    camera = SimpleNamespace(cx=160, cy=60, fx=200, fy=200, width=320, height=120)
    sequence = SimpleNamespace(name="under way", camera=camera)
    viewer.start(sequence, 8, Config(), tmp_path)
    frames = list(live_frames(objects, 8))
    for item in frames[:3]:
        viewer.frame(*item)
    early, gone = Visit(browser, urls[0]), Visit(browser, urls[0])
    early.until("dyob.length === 3 && dyob.frame === 2")
    gone.context.close()  # a closed browser is no matter for the run
    for item in frames[3:]:
        viewer.frame(*item)
        early.page.wait_for_timeout(20)
    early.until("dyob.length === 8 && dyob.frame === 7")
    assert early.box(3)["position"][2] > 14
    late = Visit(browser, urls[0])
    assert late.ask("dyob.length") == 8
    early.until("!!dyob.player.source.picture(7)")
    moved = np.eye(4)
    moved[:3, 3] = (0.5, 0.0, -1.0)
    viewer.keyframes(np.array([0]), moved[None])  # all frames hang on the first
    viewer.finish()
    for visit in (early, late):
        visit.until("dyob.player.isOver")
        visit.slide_to(0)
        np.testing.assert_allclose(visit.box(3)["position"], [2.5, 0.8, 8.0], atol=2e-3)
        own = urls[0].split("://")[1]
        assert all(url.split("://")[1].startswith(own) for url in visit.requests if "://" in url)
        assert visit.complaints == []
        visit.context.close()
    said = capfd.readouterr().err
    assert "Traceback" not in said and "never retrieved" not in said


def test_a_live_view_goes_by_the_map_that_comes(browser, tmp_path, monkeypatch):
    """A camera in a hand looks down at things close by: what is level shows as it turns about."""
    monkeypatch.setattr("viz.browser.live.MAP_EVERY_S", 0.0)
    urls: list[str] = []
    viewer = LiveViewer(announce=urls.append)
    camera = SimpleNamespace(cx=160, cy=60, fx=200, fy=200, width=320, height=120)
    viewer.start(SimpleNamespace(name="a room", camera=camera), 20, Config(), tmp_path)
    up = np.array([0.0, -np.cos(0.5), -np.sin(0.5)])  # the first camera looks down by half a rad
    points = np.random.default_rng(0).uniform([-1, -0.5, 0.8], [1, 0.5, 2], (300, 3))
    visit = Visit(browser, urls[0])
    Ts = [exp_se3(np.concatenate([-up * 0.05 * k, [0, 0, 0]])) for k in range(20)]
    for k, T in enumerate(Ts):
        n = np.ones(len(points))
        in_camera = transform_points(np.linalg.inv(T), points)
        ids = np.arange(len(points))
        uv = np.full((len(points), 2), 50.0)
        sights = Sightings(np.full(len(ids), k), 0 * ids, ids, uv, n, n, n, in_camera)
        seen = FrameObservations(k, 0.1 * k, True, T, sights)
        result = FrameResult(
            k, 0.1 * k, TrackingStatus.OK, T, np.zeros((6, 6)), MotionHypothesis.CONSTANT_VELOCITY,
            k == 0, np.empty((0, 2)), np.empty(0, np.int64), np.empty(0, bool), 0.1,
            observations=seen,
        )  # fmt: skip
        viewer.frame(Frame(k, 0.1 * k, np.zeros((120, 320, 3), np.uint8)), result)
        visit.until(f"dyob.length === {k + 1} && dyob.frame === {k}")  # each with its own map
    viewer.finish()
    visit.until("dyob.player.isOver")
    assert visit.ask("document.getElementById('points').textContent") == "300 points"
    shown = visit.ask("dyob.player.world.axes.up.toArray()")
    np.testing.assert_allclose(shown, level_axes(np.array(Ts))[0], atol=1e-5)
    np.testing.assert_allclose(shown, up, atol=0.06)
    away = np.linalg.norm(visit.ask("dyob.player.viewer.camera.position.toArray()"))
    assert 0.5 < away < 4  # the page opened before anything told that this is no street
    assert visit.complaints == []
    visit.context.close()


def test_the_page_lives_in_a_frame_of_a_notebook(browser, result, tmp_path: Path):
    from html import escape

    from viz.browser import scene_html

    inner = escape(scene_html(result, images=False), quote=True)
    outer = f'<iframe srcdoc="{inner}" style="width:900px;height:540px;border:0"></iframe>'
    (tmp_path / "outer.html").write_text(f"<!DOCTYPE html><body>{outer}", encoding="utf-8")
    context = browser.new_context(viewport=SIZE)
    page = context.new_page()
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto((tmp_path / "outer.html").as_uri())
    deadline = time.monotonic() + WAIT_S
    while not (len(page.frames) > 1 and page.frames[1].evaluate("!!(window.dyob && dyob.ready)")):
        assert time.monotonic() < deadline, complaints
        page.wait_for_timeout(50)
    assert page.frames[1].evaluate("dyob.boxes().length") == 2
    assert complaints == []
    context.close()
    assert (tmp_path / "outer.html").stat().st_size < 3e6
