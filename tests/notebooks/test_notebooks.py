"""The notebooks from top to bottom without a display, by this very Python, and what they must show.

They run in an empty folder, so that nothing of an earlier run can help them.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

import nbclient
import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "notebooks"
NAMES = ("01_walkthrough", "02_moving_objects", "03_your_own_data")
MOST_CELLS = 25
WITHOUT_VULKAN = "Open3D cannot render here"  # the one warning that a machine may give rise to


def read(name: str) -> Any:
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


@pytest.fixture(scope="module")
def executed(tmp_path_factory) -> dict[str, tuple[Any, Path]]:
    """Name -> the notebook with its outputs, and the folder that it ran in; each runs once."""
    return {}


@pytest.fixture
def run(executed, tmp_path_factory):
    def execute(name: str) -> tuple[Any, Path]:
        if name not in executed:
            folder = tmp_path_factory.mktemp(name)
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "JUPYTER_PREFER_ENV_PATH": "1"}
            client = nbclient.NotebookClient(
                read(name),
                timeout=300,
                kernel_name="python3",
                resources={"metadata": {"path": str(folder)}},
            )
            executed[name] = client.execute(env=environment), folder
        return executed[name]

    return execute


def outputs(notebook: Any) -> list[Any]:
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def text_of(notebook: Any) -> str:
    """All that a reader sees of the outputs, without pictures and pages."""
    parts = []
    for output in outputs(notebook):
        html = output.get("data", {}).get("text/html", "")
        without_pages = re.sub(r'(srcdoc|src)="[^"]*"', "", html)
        parts += [output.get("text", ""), re.sub(r"<[^>]+>", " ", without_pages)]
    return " ".join(" ".join(parts).split())


def n_pictures(notebook: Any) -> int:
    data = [output.get("data", {}) for output in outputs(notebook)]
    inside = sum(
        len(re.findall(r'<img [^>]*src="data:image/', d.get("text/html", ""))) for d in data
    )
    return inside + sum("image/png" in d for d in data)


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, f"{pattern} is not in: {text}"
    return float(found[1])


def test_these_are_all_notebooks() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_notebooks_are_kept_short_and_without_outputs(name: str) -> None:
    notebook = read(name)
    nbformat.validate(notebook)
    assert len(notebook.cells) <= MOST_CELLS
    assert not outputs(notebook)
    for cell in notebook.cells:
        assert cell.get("execution_count") is None
        assert not re.search(r"^\s*[%!]", cell.source, re.MULTILINE), "magic: " + cell.source


@pytest.mark.parametrize("name", NAMES)
def test_they_run_with_this_python_and_nothing_to_complain_of(name: str, run) -> None:
    notebook, _ = run(name)
    said = [o.text for o in outputs(notebook) if o.get("name") == "stderr"]
    assert not [text for text in said if WITHOUT_VULKAN not in text]
    assert "Open3D" not in text_of(notebook)
    pages = [o for o in outputs(notebook) if "<iframe" in o.get("data", {}).get("text/html", "")]
    assert len(pages) == 1 and "srcdoc=" in pages[0].data["text/html"]
    for output in outputs(notebook):
        shown = output.get("data", {}).get("text/html", "")
        assert not re.search(r'<(img|script|link)[^>]+(src|href)="(?!data:)', shown)
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert notebook.metadata.language_info.version.startswith(version)


def test_the_walk_through_shows_every_stage(run) -> None:
    notebook, folder = run(NAMES[0])
    titles = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    for stage in ("depth", "masks", "flow", "ORB", "pose", "who is who", "scene flow", "motion",
                  "Kalman", "map", "whole system"):  # fmt: skip
        assert any(re.search(f"^#.*{stage}", title, re.MULTILINE) for title in titles), stage
    assert n_pictures(notebook) == 12
    text = text_of(notebook)
    assert number(r"(\d+) of \d+ points agree", text) > 300
    assert 0.05 < number(r"points agree, to ([\d.]+) px", text) < 1.0
    speeds = [float(kmh) for kmh in re.findall(r"car \d+ ([\d.]+) ± [\d.]+", text)]
    assert len(speeds) == 2 and abs(min(speeds) - 36) < 3 and abs(max(speeds) - 52) < 3
    assert 0.1 < number(r"camera: off by ([\d.]+) cm", text) < 10
    assert 0.05 < number(r"off by ([\d.]+) km/h on average", text) < 2
    assert (folder / "results/walkthrough/camera_tum.txt").is_file()


def test_moving_objects_have_speeds_and_the_batch_its_table(run) -> None:
    notebook, _ = run(NAMES[1])
    assert n_pictures(notebook) == 4
    text = text_of(notebook)
    assert re.search(r"object class frames moving median km/h its std way in m \d+ car", text)
    assert number(r"the two differ by ([\d.]+) mm", text) < 1.0
    before, after = re.search(r"Objects: speed ([\d.]+) ([\d.]+) km/h", text).groups()
    assert 0 < float(after) <= 1.05 * float(before)


def test_own_data_are_found_fit_and_come_out_as_files(run) -> None:
    notebook, folder = run(NAMES[2])
    text = text_of(notebook)
    assert "layout folder, sequence my_recording" in text
    assert "UNFIT" not in text
    assert "18 of 18 frames tracked" in text
    assert "camera: (18, 4, 4)" in text
    assert re.search(r"18 poses", text), "evo's words for the trajectory"
    result = folder / "results/my_result"
    assert (result / "report.html").is_file() and (result / "renders/map_top.png").is_file()
    assert list(result.glob("objects/*_car_tum.txt"))
