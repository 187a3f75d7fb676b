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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array, Image
from viz.scene import View
from viz.splat import disc_radius_px
from viz.style import Color

logger = logging.getLogger("dyob.viz")

TIMEOUT_S = 180.0
SUPERSAMPLING = 2
CORNERS = 8  # of the discs
NEAR_M = 1e-3
ROOT = Path(__file__).resolve().parent.parent


def render_points(
    views: Sequence[View],
    points_m: Array,
    colors: NDArray[np.uint8],
    radius_m: float,
    background: Color,
) -> list[Image] | None:
    """A picture (H, W, 3) uint8 RGB a view of points (N, 3) as discs of `radius_m`, by Open3D.

    None where Open3D cannot render on this machine: there is no Vulkan driver, or it failed.
    """
    with tempfile.TemporaryDirectory(prefix="dyob-render-") as name:
        folder = Path(name)
        np.savez(
            folder / "job.npz",
            Ks=np.array([view.K for view in views]),
            Ts=np.array([view.T_view_world for view in views]),
            size=np.array(views[0].size),
            points=np.asarray(points_m, np.float32),
            colors=np.asarray(colors, np.float32) / 255.0,
            radius_m=radius_m,
            background=np.array(background) / 255.0,
        )
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        try:
            child = subprocess.run(
                [sys.executable, "-m", "viz.offscreen", str(folder)],
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
                check=False,
                cwd=folder,
                env=environment,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            logger.debug("Open3D's renderer did not answer: %s", error)
            return None
        if child.returncode != 0 or not (folder / "pictures.npy").exists():
            logger.debug("Open3D's renderer ended with %s: %s", child.returncode, child.stderr)
            return None
        return list(np.load(folder / "pictures.npy"))


def _render_job(folder: Path) -> None:
    """The child's part: read the job in `folder`, write `pictures.npy` there."""
    import cv2
    from open3d.visualization import rendering

    job = np.load(folder / "job.npz")
    size = tuple(int(n) for n in job["size"])
    W, H = (SUPERSAMPLING * n for n in size)
    renderer = rendering.OffscreenRenderer(W, H)
    renderer.scene.set_background([*_encoded(job["background"]), 1.0])
    renderer.scene.view.set_post_processing(False)  # tone mapping turns white into cream
    material = rendering.MaterialRecord()
    material.shader = "defaultUnlit"
    pictures = []
    for K_small, T in zip(job["Ks"], job["Ts"], strict=True):
        renderer.scene.clear_geometry()
        mesh = _disc_mesh(job["points"], job["colors"], View("", size, K_small, T), job["radius_m"])
        if mesh is not None:
            renderer.scene.add_geometry("map", mesh, material)
        K = K_small * SUPERSAMPLING
        K[:2, 2] += (SUPERSAMPLING - 1) / 2.0
        K[2, 2] = 1.0
        renderer.setup_camera(K, T, W, H)
        large = np.asarray(renderer.render_to_image())[..., :3]
        pictures.append(cv2.resize(large, size, interpolation=cv2.INTER_AREA))
    np.save(folder / "pictures.npy", np.array(pictures))


def _encoded(color: Array) -> Array:
    """What Open3D must be told for a ground of `color`: it takes sRGB and writes linear values."""
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)


def _disc_mesh(points_m: Array, colors: NDArray[np.float32], view: View, radius_m: float) -> Any:
    """An octagon that faces the view at every point: Open3D's own points are squares of one size.

    None where no point lies in front of the view.
    """
    import open3d as o3d

    depth = view.project(points_m)[1]
    seen = depth > NEAR_M
    if not seen.any():
        return None
    points, depth = points_m[seen].astype(np.float64), depth[seen]
    sizes_m = disc_radius_px(view, depth, radius_m) * depth / view.K[0, 0]
    angles = np.arange(CORNERS) * 2.0 * np.pi / CORNERS + np.pi / CORNERS
    corners = np.stack([np.cos(angles), np.sin(angles)], 1) @ view.T_view_world[:2, :3]
    vertices = (points[:, None] + sizes_m[:, None, None] * corners).reshape(-1, 3)
    fan = np.array([[0, k + 1, k] for k in range(1, CORNERS - 1)])  # seen from the view's side
    triangles = (fan[None] + CORNERS * np.arange(len(points))[:, None, None]).reshape(-1, 3)
    tensor = o3d.core.Tensor.from_numpy
    # A tensor mesh with normals: Open3D takes minutes over a legacy mesh of this size.
    mesh = o3d.t.geometry.TriangleMesh(
        tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.int32))
    )
    normals = np.tile(-view.T_view_world[2, :3].astype(np.float32), (len(vertices), 1))
    mesh.vertex.normals = tensor(normals)
    mesh.vertex.colors = tensor(np.repeat(colors[seen], CORNERS, 0))
    return mesh


if __name__ == "__main__":
    _render_job(Path(sys.argv[1]))
