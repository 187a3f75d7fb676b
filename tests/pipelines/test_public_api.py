"""The four public names, used as a newcomer would: a script of ten lines, in a process of its own.

Owns no accuracy; imports of the other tests cannot help these scripts.
"""

from __future__ import annotations

import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pipelines
from pipelines.io.trajectory import read_tum

ROOT = Path(__file__).resolve().parents[2]

FRAME_BY_FRAME = """
import sys
from pipelines import DyObSlam, open_sequence

sequence = open_sequence(sys.argv[1])
slam = DyObSlam(sequence.camera)
for index in range(len(sequence)):
    result = slam.process(sequence.read(index))
    x, y, z = result.T_world_camera[:3, 3]
    print(index, result.status, x, y, z)
print(len(slam.static_map()), "points")
"""

WHOLE_RUN = """
import sys
from pipelines import load_result, open_sequence, run

result = run(open_sequence(sys.argv[1]), output=sys.argv[2], frames=4)
print(result.metrics["run"]["tracked"], "frames tracked")
again = load_result(result.folder)
print(len(again.timestamps_s), "poses,", len(again.static_points_m), "points")
"""


def execute(script: str, *words: str | Path) -> list[str]:
    """Lines that a script prints, run as a program from a folder that is not the repository."""
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, words)],
        cwd=Path(words[-1]).parent,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_system_frame_by_frame(vdo_folder) -> None:
    lines = execute(FRAME_BY_FRAME, vdo_folder)
    assert len(lines) == 11
    frames = [line.split() for line in lines[:-1]]
    assert [word[:2] for word in frames] == [[str(k), "OK"] for k in range(10)]
    z = np.array([float(words[4]) for words in frames])
    assert ((np.diff(z) > 0.7) & (np.diff(z) < 1.0)).all()  # the car's steps
    assert int(lines[-1].split()[0]) > 100


def test_a_whole_run_and_its_result(vdo_folder, tmp_path) -> None:
    lines = execute(WHOLE_RUN, vdo_folder, tmp_path / "result")
    assert lines[0] == "4 frames tracked"
    assert lines[1].startswith("4 poses,")
    assert len(read_tum(tmp_path / "result/camera_tum.txt")[0]) == 4


@pytest.mark.parametrize("name", pipelines.__all__)
def test_each_name_stays_itself_when_imported_twice(name: str) -> None:
    """A submodule of the same name must not take its place once it is loaded."""
    script = (
        f"import pipelines\nfrom pipelines import {name}\n"
        f"again = getattr(pipelines, '{name}')\nprint(callable({name}), {name} is again)"
    )
    assert execute(script, ROOT / "tests") == ["True True"]


def test_the_names_are_the_four(tmp_path) -> None:
    assert set(pipelines.__all__) == {"DyObSlam", "load_result", "open_sequence", "run"}
    with pytest.raises(AttributeError, match="no attribute 'runn'"):
        _ = pipelines.runn


def test_importing_the_package_loads_nothing_heavy() -> None:
    script = "import sys, pipelines; print(sorted({'numpy', 'cv2', 'open3d'} & set(sys.modules)))"
    assert execute(script, ROOT / "tests") == ["[]"]


@pytest.mark.parametrize("name", pipelines.__all__)
def test_help_shows_each_name_with_an_example_and_what_goes_wrong(name: str) -> None:
    public = getattr(pipelines, name)
    assert name in dir(pipelines) and name in (pipelines.__doc__ or "")
    words = public.__doc__ + (public.__init__.__doc__ if isinstance(public, type) else "")
    assert ">>> " in words and re.search(r"Raises\s+\w+Error", words)
    signature = inspect.signature(public.__init__ if isinstance(public, type) else public)
    untyped = [p.name for p in signature.parameters.values() if p.annotation is p.empty]
    assert untyped in ([], ["self"]) and signature.return_annotation is not signature.empty
