"""DyOb-SLAM's estimator. The four names below are all that a program or notebook needs.

    sequence = open_sequence("path/to/data")   # frames, a camera, perhaps ground truth
    result = run(sequence)                     # the whole system, into a folder, read back
    result = load_result("results/latest")     # the same at any later time
    slam = DyObSlam(sequence.camera)           # or frame by frame, without files:
    frame_result = slam.process(sequence.read(0))

Poses are T_world_camera (4, 4) with p_world = T_world_camera @ p_camera; the world is the first
camera, x right, y down, z forward, in metres. Whatever is wrong with data, settings or files is a
`pipelines.errors.DyObError` that says in a sentence what to do.

Each name is loaded when first used, so that `import pipelines` costs nothing.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers, which do not run what stands below
    from pipelines.datasets import open_sequence
    from pipelines.dyob_slam import DyObSlam
    from pipelines.io.result import load_result
    from pipelines.runner import run

# Open3D would otherwise start a server in every notebook, and print that it does
os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")

_PUBLIC = {
    "open_sequence": "pipelines.datasets",
    "DyObSlam": "pipelines.dyob_slam",
    "run": "pipelines.runner",
    "load_result": "pipelines.io.result",
}
__all__ = ["DyObSlam", "load_result", "open_sequence", "run"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'pipelines' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
