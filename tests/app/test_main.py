"""Exit codes and sentences, and the sentence that an old Python gets."""

from __future__ import annotations

import ast
import errno
from pathlib import Path

import pytest

import app.__main__ as entry
from app import cli
from pipelines.errors import DatasetError


@pytest.mark.parametrize("name", ["__main__.py", "__init__.py"])
def test_an_old_python_can_parse_the_entry(repository: Path, name: str) -> None:
    tree = ast.parse((repository / "app" / name).read_text(), feature_version=(3, 4))
    for node in ast.walk(tree):
        assert not isinstance(node, ast.JoinedStr), "an f-string"
        assert not isinstance(node, ast.AnnAssign), "an annotated variable"
        if isinstance(node, ast.FunctionDef):
            annotated = [a for a in node.args.args if a.annotation] or node.returns
            assert not annotated, f"{node.name} has annotations"


@pytest.mark.parametrize(
    ("there", "advice"),
    [((), "install Python 3.11 or newer"), (("python3.12",), "start it with 'python3.12 -m app'")],
)
def test_an_old_python_gets_one_sentence(monkeypatch, capsys, there, advice) -> None:
    monkeypatch.setattr(entry, "_runs", lambda name: name in there)
    with pytest.raises(SystemExit) as left:
        entry.check_python((3, 6, 15))
    said = capsys.readouterr().err
    assert left.value.code == 2
    assert said == f"DyOb-SLAM needs Python 3.11 or newer, and this is Python 3.6: {advice}.\n"


@pytest.mark.parametrize("version", [(3, 11, 0), (3, 14, 2), (4, 0, 0)])
def test_a_new_python_passes(version) -> None:
    entry.check_python(version)


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (DatasetError("no images in here"), 2, "dyob-slam: no images in here\n"),
        (KeyboardInterrupt(), 130, "dyob-slam: stopped by Ctrl-C\n"),
        (OSError(errno.ENOSPC, "No space left", "out.ply"), 2, "the disk is full (out.ply)"),
        (OSError(errno.EACCES, "denied", "out.ply"), 2, "no permission to use out.ply"),
        (MemoryError(), 2, "the memory is full"),
        (ModuleNotFoundError("x", name="numpy.linalg"), 2, "package 'numpy.linalg' is missing"),
        (ModuleNotFoundError("x", name="pipelines.gone"), 1, "this is a defect of DyOb-SLAM"),
        (ImportError("libGL.so.1: cannot open"), 1, "this is a defect of DyOb-SLAM"),
        (ValueError("shapes differ"), 1, "ValueError: shapes differ (please report it"),
    ],
)
def test_each_error_is_one_sentence_and_a_code(monkeypatch, capsys, error, code, words) -> None:
    def fail(argv):
        raise error

    monkeypatch.setattr(cli, "main", fail)
    assert entry.main(["run", "x"]) == code
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_debug_shows_the_traceback(monkeypatch, capsys) -> None:
    def fail(argv):
        raise DatasetError("no images in here")

    monkeypatch.setattr(cli, "main", fail)
    assert entry.main(["run", "x", "--debug"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("Traceback")
    assert said.endswith("dyob-slam: no images in here\n")
