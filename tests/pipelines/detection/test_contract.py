"""What every detector of the table promises, and which one `auto` stands for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.config import DetectorConfig
from pipelines.detection import DETECTORS, NETWORKS, Detector, choose_detector, load_detector
from pipelines.errors import ConfigError, ModelError
from pipelines.object_types import UNNAMED_CLASS, Detections
from pipelines.types import Frame

CAR, TOASTER = 2, 70  # of COCO's 80


@pytest.fixture
def model_of(make_yolo, make_mask_rcnn) -> Callable[[str], str]:
    """Detector -> path of a small network that sees cars and a toaster, "" for one without."""

    def find(name: str) -> str:
        if name == "yolo_seg":
            rows = [
                ((64, 48, 128, 96), CAR, 0.9),
                ((40, 40, 30, 30), CAR, 0.5),
                ((90, 70, 40, 30), TOASTER, 0.8),
                ((20, 20, 30, 30), CAR, 0.1),
            ]
            return str(make_yolo(rows))
        if name == "mask_rcnn":
            boxes = [[10, 10, 90, 80], [60, 30, 120, 90], [5, 5, 50, 50]]
            return str(make_mask_rcnn(boxes, [3, 1, 80], [0.9, 0.6, 0.8]))
        return ""

    return find


@pytest.fixture(params=DETECTORS)
def detector(request, model_of) -> Detector:
    return load_detector(DetectorConfig(name=request.param, model=model_of(request.param)))


def assert_equal(a: Detections, b: Detections) -> None:
    np.testing.assert_array_equal(a.labels, b.labels)
    np.testing.assert_array_equal(a.label_ids, b.label_ids)
    np.testing.assert_array_equal(a.class_names, b.class_names)
    np.testing.assert_array_equal(a.scores, b.scores)


def as_grey(frame: Frame) -> Frame:
    return replace(frame, image=np.ascontiguousarray(frame.image[..., 0]))


@pytest.mark.parametrize("change", [lambda frame: frame, as_grey], ids=["colour", "grey"])
def test_answers_fit_the_frame(detector: Detector, frame: Frame, change) -> None:
    frame = change(frame)
    found = detector.detect(frame)
    assert (found.labels.shape, found.labels.dtype) == (frame.image.shape[:2], np.int32)
    assert (found.label_ids.dtype, found.scores.dtype) == (np.int32, np.float64)
    assert len(set(found.label_ids)) == len(found)
    assert (found.label_ids > 0).all()
    assert set(np.unique(found.labels)) <= {0, *found.label_ids}
    assert ((found.scores >= 0) & (found.scores <= 1)).all()
    assert set(found.class_names) <= {*DetectorConfig().classes, UNNAMED_CLASS}


def test_all_but_motion_find_the_car(detector: Detector, frame: Frame) -> None:
    found = detector.detect(frame)
    assert ("car" in found.class_names) == (type(detector).__name__ != "MotionDetector")
    assert "toaster" not in found.class_names


def test_the_frame_stays_as_it_is(detector: Detector, frame: Frame) -> None:
    image, labels = frame.image.copy(), frame.instance_labels.copy()
    detector.detect(frame)
    np.testing.assert_array_equal(frame.image, image)
    np.testing.assert_array_equal(frame.instance_labels, labels)


def test_the_same_frame_gives_the_same_answer(detector: Detector, frame: Frame) -> None:
    first = detector.detect(frame)
    other = replace(frame, image=255 - frame.image, instance_labels=None)
    detector.detect(other)
    assert_equal(first, detector.detect(frame))


def test_it_may_be_called_from_several_threads(detector: Detector, frame: Frame) -> None:
    answers: list[Detections] = []
    threads = [
        threading.Thread(target=lambda: answers.append(detector.detect(frame))) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 3
    for answer in answers:
        assert_equal(answer, detector.detect(frame))


def test_movable_classes_are_a_setting(frame: Frame, model_of) -> None:
    for name in ("files", *NETWORKS):
        config = DetectorConfig(name=name, model=model_of(name), classes=("toaster",))
        found = load_detector(config).detect(frame)
        assert "toaster" in found.class_names, name
        assert "car" not in found.class_names, name


def test_an_unknown_name_names_the_nearest() -> None:
    words = r"'yolo_segm'; did you mean 'yolo_seg'\? There are: auto, files, yolo_seg"
    with pytest.raises(ConfigError, match=words):
        load_detector(DetectorConfig(name="yolo_segm"))
    with pytest.raises(ConfigError, match=words):
        choose_detector(DetectorConfig(name="yolo_segm"), True)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_without_its_file_says_how_to_get_it(name: str) -> None:
    with pytest.raises(ModelError, match=f"is missing; .*models add {name} FILE.*detector.model="):
        load_detector(DetectorConfig(name=name))
    with pytest.raises(ModelError, match=r"expected a model file, found nothing at no/such\.onnx"):
        load_detector(DetectorConfig(name=name, model="no/such.onnx"))


@pytest.mark.parametrize("name", NETWORKS)
def test_a_damaged_file_is_one_sentence(name: str, frame: Frame, model_of, tmp_path) -> None:
    whole = Path(model_of(name)).read_bytes()
    cut = tmp_path / "cut.onnx"
    for content in (whole[: len(whole) // 2], b"", b"<html>not found</html>"):
        cut.write_bytes(content)
        detector = load_detector(DetectorConfig(name=name, model=str(cut)))
        with pytest.raises(ModelError, match="expected a network as an ONNX file") as raised:
            detector.detect(frame)
        assert "\n" not in str(raised.value)


def test_a_network_of_another_kind_is_refused(frame: Frame, model_of) -> None:
    swapped = {"yolo_seg": "mask_rcnn", "mask_rcnn": "yolo_seg"}
    for name, other in swapped.items():
        detector = load_detector(DetectorConfig(name=name, model=model_of(other)))
        with pytest.raises(ModelError, match=r"expected (a network with the input|Mask)"):
            detector.detect(frame)


def test_auto_takes_files_then_networks_then_motion(model_of, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("DYOB_MODELS", str(tmp_path / "store"))
    auto = DetectorConfig()
    assert choose_detector(auto, sequence_has_masks=True) == "files"
    assert choose_detector(auto, sequence_has_masks=False) == "motion"
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "maskrcnn_resnet50_fpn_coco.onnx").touch()
    assert choose_detector(auto, sequence_has_masks=False) == "mask_rcnn"
    (tmp_path / "store" / "yolo_seg.onnx").touch()
    assert choose_detector(auto, sequence_has_masks=False) == "yolo_seg"
    assert choose_detector(auto, sequence_has_masks=True) == "files"


@pytest.mark.parametrize("name", NETWORKS)
def test_auto_with_a_model_is_the_network_of_that_file(name: str, model_of) -> None:
    auto = DetectorConfig(model=model_of(name))
    assert choose_detector(auto, sequence_has_masks=True) == name
    with pytest.raises(ModelError, match=r"detector\.model: expected an ONNX file, found nothing"):
        choose_detector(DetectorConfig(model="no/such.onnx"), sequence_has_masks=True)


@pytest.mark.parametrize("name", DETECTORS)
def test_a_name_of_the_table_stays(name: str) -> None:
    assert choose_detector(DetectorConfig(name=name), sequence_has_masks=True) == name
