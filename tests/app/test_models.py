"""The verb `models`: what it lists, and each way in, in a process of its own where it matters."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest

from app import bootstrap, cli, models
from app.environment import SetupError
from pipelines import models as store
from pipelines.errors import ModelError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch) -> Path:
    folder = tmp_path / "models"
    monkeypatch.setenv("DYOB_MODELS", str(folder))
    return folder


@pytest.fixture
def yolo(tmp_path: Path) -> Path:
    """An ONNX file with float outputs only, as YOLO networks have."""
    return write_onnx(tmp_path / "small.onnx", "FLOAT")


def write_onnx(path: Path, kind: str) -> Path:
    onnx = pytest.importorskip("onnx")
    value, tensor = onnx.helper.make_tensor_value_info, onnx.TensorProto
    node = onnx.helper.make_node("Cast", ["images"], ["out"], to=getattr(tensor, kind))
    graph = onnx.helper.make_graph(
        [node],
        "small",
        [value("images", tensor.FLOAT, [1, 3, None, None])],
        [value("out", getattr(tensor, kind), [1, 3, None, None])],
    )
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), path)
    return path


def app(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "app", "models", *map(str, words)],
        cwd=ROOT,
        env={**os.environ, "DYOB_NO_SETUP": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def parse(*words: str | Path) -> Namespace:
    return cli.build_parser().parse_args(["models", *map(str, words)])


def test_each_model_is_listed_with_its_licence_and_the_way_to_it(capsys, folder) -> None:
    assert models.models(parse()) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"Models' folder: {folder}\n")
    for name, model in store.MODELS.items():
        assert f"\n{name}: {model.what}\n" in said
        assert model.licence in said
    assert "AGPL-3.0" in said and "never shipped" in said
    assert said.count("not there") == len(store.MODELS)
    assert "170 MB to download" in said
    assert "python3 -m app models fetch mask_rcnn`," in said


def test_add_then_list_in_processes_of_their_own(yolo: Path, folder: Path) -> None:
    done = app("add", "yolo_seg", yolo)
    assert done.returncode == 0, done.stderr
    assert "run DATA --set detector.name=yolo_seg\n" in done.stdout
    assert (folder / "yolo_seg.onnx").read_bytes() == yolo.read_bytes()
    assert f"{folder / 'yolo_seg.onnx'}, 0 MB" in app().stdout
    (folder / "yolo_seg.onnx").write_bytes(b"damaged")
    listed = app()
    assert listed.returncode == 0
    assert "DAMAGED:" in listed.stdout


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fetch", "yolo_seg"], "yolo export model=yolov8n-seg.pt"),
        (["fetch", "yolo"], "did you mean 'yolo_seg'"),
        (["add", "yolo_seg", "no/such.onnx"], "expected a file to add, found none at no/such.onnx"),
        (["add", "yolo_seg", "pyproject.toml"], "expected a network as an ONNX file"),
        (["export", "yolo_seg"], "yolo_seg cannot be exported, mask_rcnn can"),
        (["export", "mask_rcnn", "--unchecked"], "name them with --weights FILE"),
        (["export", "mask_rcnn", "--weights", "no.pth"], "found no file at no.pth"),
        (["add", "yolo_seg"], "required: FILE"),
        (["bring", "yolo_seg"], "invalid choice: 'bring'"),
    ],
)
def test_what_cannot_be_done_is_code_2_and_a_sentence(words, sentence, folder) -> None:
    done = app(*words)
    assert done.returncode == 2, done.stdout + done.stderr
    assert sentence in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(folder.glob("*.onnx"))


def test_a_network_of_another_kind_is_not_added(tmp_path: Path, yolo: Path, folder: Path) -> None:
    with pytest.raises(ModelError, match=f"did you mean `.* models add yolo_seg {yolo}`"):
        models.models(parse("add", "mask_rcnn", yolo))
    whole_numbers = write_onnx(tmp_path / "labels.onnx", "INT64")
    with pytest.raises(ModelError, match="found one with the outputs of mask_rcnn"):
        models.models(parse("add", "yolo_seg", whole_numbers))
    assert not folder.exists()
    assert models.models(parse("add", "mask_rcnn", whole_numbers)) == 0


@pytest.fixture
def exports(monkeypatch) -> list[tuple[Path, bool]]:
    """Calls of the export, which writes a small file in place of a network."""
    calls: list[tuple[Path, bool]] = []

    def export(weights: Path, path: Path, any_weights: bool = False) -> None:
        calls.append((weights, any_weights))
        path.write_bytes(b"network of " + weights.read_bytes())

    monkeypatch.setattr("pipelines.detection.mask_rcnn_export.export_mask_rcnn", export)
    monkeypatch.setattr(bootstrap, "ensure_torch", lambda: None)
    return calls


def serve(monkeypatch, content: bytes, tmp_path: Path) -> None:
    """Let the published weights come from a file, with that file's checksum."""
    source = tmp_path / "published.pth"
    source.write_bytes(content)
    known = store.MODELS["mask_rcnn_weights"]
    digest = hashlib.sha256(content).hexdigest()
    changed = replace(known, url=source.as_uri(), sha256=digest[:8])
    monkeypatch.setitem(store.MODELS, "mask_rcnn_weights", changed)


def test_fetching_what_is_made_here_fetches_the_weights_and_makes_it(
    monkeypatch, exports, folder, tmp_path, capsys
) -> None:
    serve(monkeypatch, b"weights", tmp_path)
    for _ in range(2):  # the second time it is there
        assert models.models(parse("fetch", "mask_rcnn")) == 0
    assert exports == [(store.model_path("mask_rcnn_weights"), False)]
    assert store.find_model("mask_rcnn").read_bytes() == b"network of weights"
    assert "--set detector.name=mask_rcnn\n" in capsys.readouterr().out


def test_export_takes_weights_and_a_place_of_ones_own(exports, folder, tmp_path, capsys) -> None:
    own, output = tmp_path / "own.pth", tmp_path / "own.onnx"
    own.write_bytes(b"own")
    words = ("export", "mask_rcnn", "--weights", own, "--output", output, "--unchecked")
    assert models.models(parse(*words)) == 0
    assert exports == [(own, True)]
    assert output.read_bytes() == b"network of own"
    assert not folder.exists()
    assert f"--set detector.model={output}\n" in capsys.readouterr().out


def test_export_without_torch_says_what_to_install(monkeypatch, tmp_path, folder) -> None:
    def fail() -> None:
        raise SetupError("this needs torch")

    monkeypatch.setattr(bootstrap, "ensure_torch", fail)
    (tmp_path / "own.pth").touch()
    with pytest.raises(SetupError, match="this needs torch"):
        models.models(parse("export", "mask_rcnn", "--weights", tmp_path / "own.pth"))
    assert not list(folder.glob("*"))


@pytest.mark.parametrize("action", ["fetch", "add", "export"])
def test_help_of_each_action_begins_with_examples(action: str, capsys) -> None:
    with pytest.raises(SystemExit) as left:
        parse(action, "--help")
    assert left.value.code == 0
    assert capsys.readouterr().out.startswith(f"Examples:\n  python3 -m app models {action} ")


def test_train_vocabulary_writes_what_load_reads(tmp_path: Path) -> None:
    import cv2

    from pipelines.backend.training_images import paint_leaves
    from pipelines.backend.vocabulary_files import load_vocabulary

    (tmp_path / "photos").mkdir()
    for seed in range(3):
        cv2.imwrite(str(tmp_path / f"photos/{seed}.png"), paint_leaves(seed))
    one = tmp_path / "photos/0.png"
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for file in files:
        words = ("--output", file, "--branching", "5", "--depth", "2", "--seed", "3")
        done = app("train-vocabulary", tmp_path / "photos", one, *words)
        assert done.returncode == 0, done.stderr
        assert f"{file}: 25 words of 6000 descriptors in 4 images, 0.0 MB" in done.stdout
        assert f"--set places.vocabulary={file}" in done.stdout
    assert files[0].read_bytes() == files[1].read_bytes()
    vocabulary = load_vocabulary(files[0])
    assert (vocabulary.n_words, vocabulary.branching, vocabulary.depth) == (25, 5, 2)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["NOWHERE", "--output", "v.npz"], "NOWHERE: expected the folder of a sequence"),
        (["NOWHERE", "--output", "v.yml"], "v.yml: expected the name of a vocabulary to end in"),
        (["NOWHERE"], "required: --output"),
        (["a.png", "--output", "v.npz", "--depth", "0"], "--depth: expected a whole number of at"),
        (["a.png", "--output", "v.npz", "--branching", "1"], "a branching of 2 or more"),
    ],
)
def test_train_vocabulary_says_what_is_wrong(words: list[str], said: str) -> None:
    done = app("train-vocabulary", *words)
    assert done.returncode == 2
    assert done.stdout == ""
    assert said in done.stderr
    assert "Traceback" not in done.stderr
