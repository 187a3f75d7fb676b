"""Point clouds to pixels by Open3D's off-screen renderer, which needs Vulkan but no display.

Owns Open3D's rendering, in a process of its own: without a driver Open3D ends the process instead
of raising, and with one it writes of its engine to the terminal. Lines and text come on top.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array, Image
from viz.scene import View
from viz.splat import SHADED_FROM_PX, ball_shade, disc_radius_px, faded
from viz.style import Color

logger = logging.getLogger("dyob.viz")

TIMEOUT_S = 180.0  # for one picture
SUPERSAMPLING = 2
CORNERS = 12  # of the discs
ROOT = Path(__file__).resolve().parent.parent


def render_points(
    views: Sequence[View],
    points_m: Array,
    colors: NDArray[np.uint8],
    radius_m: float,
    background: Color,
) -> Iterator[Image]:
    """A picture (H, W, 3) uint8 RGB a view of points (N, 3) as discs of `radius_m`, by Open3D.

    Ends early where Open3D cannot render on this machine: there is no Vulkan driver, or it failed.
    """
    with tempfile.TemporaryDirectory(prefix="dyob-render-") as name:
        job = Path(name) / "job.npz"
        np.savez(
            job,
            Ks=np.array([view.K for view in views]),
            Ts=np.array([view.T_view_world for view in views]),
            nears_m=np.array([view.near_m for view in views]),
            hazes=np.array([view.haze or (0.0, 1.0, 0.0) for view in views]),
            size=np.array(views[0].size),
            points=np.asarray(points_m, np.float64),
            colors=np.asarray(colors, np.uint8),
            radius_m=radius_m,
            background=np.array(background),
        )
        try:
            with subprocess.Popen(
                [sys.executable, "-m", "viz.offscreen", str(job)],
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd=name,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            ) as child:
                try:
                    yield from _pictures(child, views[0].size, len(views))
                finally:
                    child.kill()
        except OSError as error:
            logger.debug("Open3D's renderer did not start: %s", error)


def _pictures(child: subprocess.Popen[bytes], size: tuple[int, int], n: int) -> Iterator[Image]:
    """The pictures that the child writes, as long as each comes whole and in time."""
    assert child.stdout is not None
    n_bytes = size[0] * size[1] * 3
    for _ in range(n):
        watchdog = threading.Timer(TIMEOUT_S, child.kill)
        watchdog.start()
        data = child.stdout.read(n_bytes)
        watchdog.cancel()
        if len(data) < n_bytes:
            logger.debug("Open3D's renderer ended with %s", child.wait())
            return
        yield np.frombuffer(data, np.uint8).reshape(size[1], size[0], 3).copy()


def _render_job(path: Path) -> None:
    """The child's part: read the job, write the bytes of each picture to what was its stdout."""
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # the engine's own words go elsewhere
        import cv2
        from open3d.visualization import rendering

        job = np.load(path)
        size = int(job["size"][0]), int(job["size"][1])
        W, H = (SUPERSAMPLING * n for n in size)
        background: Color = tuple(job["background"].tolist())
        renderer = rendering.OffscreenRenderer(W, H)
        renderer.scene.set_background([*_encoded(job["background"] / 255.0), 1.0])
        renderer.scene.view.set_post_processing(False)  # tone mapping turns white into cream
        material = rendering.MaterialRecord()
        material.shader = "defaultUnlit"
        for K_small, T, near_m, haze in zip(
            job["Ks"], job["Ts"], job["nears_m"], job["hazes"], strict=True
        ):
            view = View("", size, K_small, T, None, float(near_m), tuple(haze.tolist()))
            renderer.scene.clear_geometry()
            mesh = _disc_mesh(view, job["points"], job["colors"], job["radius_m"], background)
            if mesh is not None:
                renderer.scene.add_geometry("map", mesh, material)
            K = K_small * SUPERSAMPLING
            K[:2, 2] += (SUPERSAMPLING - 1) / 2.0
            K[2, 2] = 1.0
            renderer.setup_camera(K, T, W, H)
            large = np.asarray(renderer.render_to_image())[..., :3]
            out.write(cv2.resize(large, size, interpolation=cv2.INTER_AREA).tobytes())
            out.flush()


def _encoded(color: Array) -> Array:
    """What Open3D must be told for a ground of `color`: it takes sRGB and writes linear values."""
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)


def _disc_mesh(
    view: View, points_m: Array, colors: NDArray[np.uint8], radius_m: float, background: Color
) -> Any:
    """A polygon that faces the view at every point: Open3D's own points are squares of one size.

    It is darker at its corners, like a ball. None where no point lies in the picture.
    """
    import open3d as o3d

    uv, depth = view.project(points_m)
    size = np.array(view.size)
    with np.errstate(invalid="ignore"):
        seen = (depth > view.near_m) & (np.abs(uv - size / 2.0) < size / 2.0 + 20).all(1)
    if not seen.any():
        return None
    points, depth = points_m[seen], depth[seen]
    radius_px = disc_radius_px(view, depth, radius_m)
    sizes_m = radius_px * depth / view.K[0, 0]
    angles = np.arange(CORNERS) * 2.0 * np.pi / CORNERS + np.pi / CORNERS
    corners = np.stack([np.cos(angles), np.sin(angles)], 1) @ view.T_view_world[:2, :3]
    corners = np.concatenate([np.zeros((1, 3)), corners])  # the middle first
    vertices = (points[:, None] + sizes_m[:, None, None] * corners).reshape(-1, 3)
    around = np.arange(CORNERS)
    fan = np.stack([np.zeros_like(around), 1 + (around + 1) % CORNERS, 1 + around], 1)
    each = (CORNERS + 1) * np.arange(len(points))[:, None, None]
    tensor = o3d.core.Tensor.from_numpy
    # A tensor mesh with normals: Open3D takes minutes over a legacy mesh of this size.
    mesh = o3d.t.geometry.TriangleMesh(
        tensor(vertices.astype(np.float32)), tensor((fan + each).reshape(-1, 3).astype(np.int32))
    )
    normals = np.tile(-view.T_view_world[2, :3].astype(np.float32), (len(vertices), 1))
    mesh.vertex.normals = tensor(normals)
    rgb = faded(view, colors[seen].astype(np.float32), depth, background) / 255.0
    rim = np.where(radius_px >= SHADED_FROM_PX, ball_shade(np.ones(1))[0], 1.0)
    shades = np.concatenate([np.ones((len(points), 1)), np.tile(rim[:, None], CORNERS)], 1)
    mesh.vertex.colors = tensor(
        (rgb[:, None] * shades[..., None]).reshape(-1, 3).astype(np.float32)
    )
    return mesh


if __name__ == "__main__":
    _render_job(Path(sys.argv[1]))
