"""The json beside a mask."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.files import DamagedFileError
from pipelines.datasets.mask_classes import mask_classes_text, read_mask_classes
from pipelines.errors import FrameError

Write = Callable[[str], Path]


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(mask_classes_text({12: ("truck", None), 3: ("car", 0.5)}))
    assert read_mask_classes(path) == {3: "car", 12: "truck"}
    assert '"score": 0.5' in path.read_text()


def test_a_class_may_stand_alone(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"1": "car"}')
    assert read_mask_classes(tmp_path / "a.json") == {1: "car"}


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('{"1": {"class": "car"', DamagedFileError),
        ("[1, 2]", FrameError),
        ('{"one": "car"}', FrameError),
        ('{"1": {"score": 0.5}}', FrameError),
        ('{"1": {"class": 7}}', FrameError),
    ],
)
def test_other_forms_are_named(tmp_path: Path, text: str, error: type[Exception]) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(error, match=r"a\.json: expected"):
        read_mask_classes(tmp_path / "a.json")


def test_a_folder_hands_classes_to_its_frames(
    write_tree: Write, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tree("folder")
    (root / "masks/1.json").write_text(mask_classes_text({1: ("car", 0.9)}))
    (root / "masks/2.json").write_text("torn {")
    sequence = open_sequence(root)
    assert sequence.read(0).instance_classes is None
    assert sequence.read(1).instance_classes == {1: "car"}
    assert caplog.text == ""
    torn = sequence.read(2)
    assert torn.instance_labels is not None
    assert torn.instance_classes is None
    assert "frame 2 goes without classes" in caplog.text
