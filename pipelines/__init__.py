"""DyOb-SLAM's estimator. The public names below are all that a program or notebook needs.

    sequence = open_sequence("path/to/data")
    result = run(sequence)

Each name is loaded when first used, so that `import pipelines` costs nothing.
"""

import os
from importlib import import_module
from typing import Any

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
