"""Masks and flow of a frame: which method answers, when it does not, and what is not swallowed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future

import cv2
import numpy as np
import pytest

from pipelines import perception
from pipelines.config import DetectorConfig, FlowConfig
from pipelines.errors import ConfigError, ModelError
from pipelines.object_types import Detections
from pipelines.perception import DenseFlow, Segmentation
from pipelines.types import Frame

H, W = 60, 90
Detect = Callable[[Frame], Detections]


def box(label: int) -> np.ndarray:
    labels = np.zeros((H, W), np.int32)
    labels[20:40, 30:60] = label
    return labels


def frame_of(index: int, labels: np.ndarray | None = None, **more) -> Frame:
    return Frame(index, 0.1 * index, np.zeros((H, W), np.uint8), instance_labels=labels, **more)


def answer_to(frame: Frame) -> Detections:
    """Names its frame: the label is the frame's index + 1."""
    label = frame.index + 1
    ids = np.array([label], np.int32)
    return Detections(box(label), ids, np.array(["car"]), np.ones(1))


class Network:
    """A detector that does what it is told."""

    def __init__(self, detect: Detect) -> None:
        self.detect = detect


@pytest.fixture
def segmentation(monkeypatch) -> Callable[..., Segmentation]:
    """A segmentation by a network that answers as `detect` does."""

    def make(detect: Detect, **settings) -> Segmentation:
        monkeypatch.setattr(perception, "load_detector", lambda config: Network(detect))
        return Segmentation(DetectorConfig(name="yolo_seg", **settings))

    return make


def answered(found: Detections | None) -> int | None:
    """Index of the frame that an answer is to."""
    return None if found is None else int(found.label_ids[0]) - 1


# ---------------------------------------------------------------- the choice


def test_auto_takes_the_masks_of_the_sequence() -> None:
    segmentation = Segmentation(DetectorConfig())
    found = segmentation.detect(frame_of(0, box(7), instance_classes={7: "car"}))
    assert segmentation.name == "files"
    assert (found.label_ids.tolist(), found.class_names.tolist()) == ([7], ["car"])
    np.testing.assert_array_equal(found.labels, box(7))


def test_auto_without_masks_and_networks_leaves_all_to_geometry() -> None:
    segmentation = Segmentation(DetectorConfig())
    assert segmentation.detect(frame_of(0)) is None
    assert segmentation.name == "motion"


def test_auto_without_masks_takes_a_network_that_is_at_hand(monkeypatch) -> None:
    monkeypatch.setattr("pipelines.detection.is_at_hand", lambda name: name == "mask_rcnn")
    asked = []

    def load(config: DetectorConfig) -> Network:
        asked.append(config.name)
        return Network(answer_to)

    monkeypatch.setattr(perception, "load_detector", load)
    segmentation = Segmentation(DetectorConfig())
    assert answered(segmentation.detect(frame_of(0))) == 0
    assert (segmentation.name, asked) == ("mask_rcnn", ["mask_rcnn"])


def test_a_first_frame_whose_mask_is_missing_does_not_decide_for_all() -> None:
    segmentation = Segmentation(DetectorConfig())
    assert segmentation.detect(frame_of(0)) is None
    found = segmentation.detect(frame_of(1, box(3)))
    assert segmentation.name == "files"
    assert found.label_ids.tolist() == [3]


def test_masks_do_not_overrule_a_method_that_was_named() -> None:
    segmentation = Segmentation(DetectorConfig(name="motion"))
    assert [segmentation.detect(frame_of(k, box(1))) for k in range(2)] == [None, None]
    assert segmentation.name == "motion"


def test_a_mask_that_is_missing_is_no_answer_but_an_empty_one_is() -> None:
    segmentation = Segmentation(DetectorConfig())
    segmentation.detect(frame_of(0, box(1)))
    assert segmentation.detect(frame_of(1)) is None
    empty = segmentation.detect(frame_of(2, np.zeros((H, W), np.int32)))
    assert empty is not None
    assert len(empty) == 0


# ---------------------------------------------------------- when it has turns


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_network_has_its_turn_on_every_nth_frame(segmentation, n: int) -> None:
    asked = segmentation(answer_to, every_n=n)
    found = [answered(asked.detect(frame_of(k))) for k in range(7)]
    assert found == [k if k % n == 0 else None for k in range(7)]


def test_turns_count_frames_that_are_seen_not_their_indices(segmentation) -> None:
    asked = segmentation(answer_to, every_n=2)
    assert [answered(asked.detect(frame_of(k))) for k in (1, 3, 5, 7)] == [1, None, 5, None]


def test_a_failure_is_a_warning_and_costs_its_frame_alone(segmentation, caplog) -> None:
    def detect(frame: Frame) -> Detections:
        if frame.index == 2:
            raise ZeroDivisionError("no such pixel")
        return answer_to(frame)

    asked = segmentation(detect)
    with caplog.at_level(logging.WARNING):
        found = [answered(asked.detect(frame_of(k))) for k in range(5)]
    assert found == [0, 1, None, 3, 4]
    (said,) = [record.getMessage() for record in caplog.records]
    assert "frame 2: the detector failed (ZeroDivisionError: no such pixel)" in said


@pytest.mark.parametrize("error", [ModelError("the file is damaged"), ConfigError("no such size")])
def test_what_no_frame_can_mend_ends_the_run(segmentation, error: Exception) -> None:
    def detect(frame: Frame) -> Detections:
        raise error

    with pytest.raises(type(error), match=str(error)):
        segmentation(detect).detect(frame_of(0))


def test_a_missing_network_is_told_at_once(tmp_path) -> None:
    for config in (
        DetectorConfig(name="yolo_seg"),
        DetectorConfig(model=str(tmp_path / "none.onnx")),
    ):
        with pytest.raises(ModelError):
            Segmentation(config).detect(frame_of(0))


# ------------------------------------------------------------ late answers


class SlowNetwork:
    """Answers to frame 0 only when told to, to others at once; with an error if it has one."""

    def __init__(self, error: Exception | None = None) -> None:
        self.may_answer, self.is_done = threading.Event(), threading.Event()
        self.error = error
        self.asked: list[int] = []

    def detect(self, frame: Frame) -> Detections:
        self.asked.append(frame.index)
        if frame.index == 0:
            self.may_answer.wait(60.0)
            self.is_done.set()
            if self.error is not None:
                raise self.error
        return answer_to(frame)

    def answer_now(self, segmentation: Segmentation) -> None:
        """Let the late answer come, and wait until it is there."""
        self.may_answer.set()
        assert self.is_done.wait(60.0)
        assert segmentation._pool is not None
        segmentation._pool.submit(lambda: None).result(60.0)  # runs after the late one has ended


def test_a_late_network_is_not_waited_for_and_its_answer_dropped(segmentation, monkeypatch) -> None:
    network = SlowNetwork()
    asked = segmentation(network.detect, timeout_ms=300.0)
    assert asked.detect(frame_of(0)) is None
    waited: list[object] = []
    with monkeypatch.context() as patch:
        patch.setattr(Future, "result", lambda *arguments: waited.append(arguments))
        assert [asked.detect(frame_of(k)) for k in (1, 2)] == [None, None]
    assert waited == []  # a busy network is not asked, so not waited for
    assert network.asked == [0]
    network.answer_now(asked)
    assert [answered(asked.detect(frame_of(k))) for k in (3, 4)] == [3, 4]  # never that to frame 0
    assert network.asked == [0, 3, 4]


def test_a_network_in_time_is_as_one_without_a_limit(segmentation) -> None:
    asked = segmentation(answer_to, timeout_ms=60_000.0)
    assert [answered(asked.detect(frame_of(k))) for k in range(3)] == [0, 1, 2]


def test_a_late_failure_is_a_warning_that_names_its_frame(segmentation, caplog) -> None:
    network = SlowNetwork(ZeroDivisionError("no such pixel"))
    asked = segmentation(network.detect, timeout_ms=10.0)
    assert asked.detect(frame_of(0)) is None
    network.answer_now(asked)
    with caplog.at_level(logging.WARNING):
        asked.detect(frame_of(1))
    assert "frame 0: the detector failed (ZeroDivisionError" in caplog.text


def test_a_late_model_error_is_not_swallowed(segmentation) -> None:
    network = SlowNetwork(ModelError("the file is damaged"))
    asked = segmentation(network.detect, timeout_ms=10.0)
    assert asked.detect(frame_of(0)) is None
    network.answer_now(asked)
    with pytest.raises(ModelError, match="damaged"):
        asked.detect(frame_of(1))


# --------------------------------------------------------------------- flow

SHIFT_PX = 2  # of the picture, in x, from frame to frame


def picture(index: int) -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(H, W + 40)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    wide = np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    left = 30 - SHIFT_PX * index
    return np.ascontiguousarray(wide[:, left : left + W])


def given_flow() -> np.ndarray:
    """To be told from what is computed."""
    return np.full((H, W, 2), 7.0, np.float32)


def moving(index: int, given: bool = True) -> Frame:
    flow = given_flow() if given else None
    return Frame(index, 0.1 * index, picture(index), flow_prev_to_curr_px=flow)


def kind(flow: DenseFlow, frame: Frame, n_steps: int = 1) -> str:
    """Whether the flow to a frame is none, the given one, or computed and right."""
    found = flow.compute(frame)
    if found is None:
        return "none"
    assert found.shape == (H, W, 2)
    if (found == 7.0).all():
        return "given" if flow.is_given else "given, said to be computed"
    middle = np.nanmedian(found[10:-10, 15:-15], axis=(0, 1))
    np.testing.assert_allclose(middle, [SHIFT_PX * n_steps, 0.0], atol=0.3)
    return "computed, said to be given" if flow.is_given else "computed"


def test_auto_takes_the_flow_of_the_sequence_and_computes_what_is_missing() -> None:
    flow = DenseFlow(FlowConfig())
    given = [True, True, False, True, True]
    found = [kind(flow, moving(k, given[k])) for k in range(5)]
    assert found == ["none", "given", "computed", "given", "given"]


def test_given_flow_is_used_only_from_the_frame_before() -> None:
    flow = DenseFlow(FlowConfig())
    assert [kind(flow, moving(k)) for k in (2, 3)] == ["none", "given"]
    assert kind(flow, moving(5), n_steps=2) == "computed"  # it begins at frame 4, which is missing
    assert kind(flow, moving(6)) == "given"


def test_files_alone_computes_nothing() -> None:
    flow = DenseFlow(FlowConfig(name="files"))
    found = [kind(flow, moving(0)), kind(flow, moving(1)), kind(flow, moving(2, given=False))]
    assert found == ["none", "given", "none"]
    assert kind(flow, moving(4)) == "none"
    assert not flow.is_given


def test_a_computed_flow_ignores_the_given_one() -> None:
    flow = DenseFlow(FlowConfig(name="dis"))
    assert [kind(flow, moving(k)) for k in range(3)] == ["none", "computed", "computed"]


def test_a_first_flow_that_is_missing_does_not_decide_for_all() -> None:
    flow = DenseFlow(FlowConfig())
    found = [kind(flow, moving(k, given=k != 1)) for k in range(4)]
    assert found == ["none", "computed", "given", "given"]


def test_without_any_given_flow_all_is_computed() -> None:
    flow = DenseFlow(FlowConfig())
    found = [kind(flow, moving(k, given=False)) for k in range(3)]
    assert found == ["none", "computed", "computed"]


def test_an_unknown_flow_is_named() -> None:
    flow = DenseFlow(FlowConfig(name="dsi"))
    flow.compute(moving(0))
    with pytest.raises(ConfigError, match="did you mean 'dis'"):
        flow.compute(moving(1))
