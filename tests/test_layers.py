"""Who may import whom, and who may print: read from the sources, so that nothing need run."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
RANK = {"pipelines": 0, "viz": 1, "app": 2}
STDLIB_ONLY = (
    "cli",
    "arguments",
    "bootstrap",
    "environment",
    "installation",
    "system_libraries",
    "__main__",
)
# Heavy packages and the only places that may import them at all.
OWNERS = {
    "gtsam": ("pipelines/backend/",),
    "gtsam_unstable": ("pipelines/backend/",),
    "av": ("viz/mp4.py",),
    "meshcat": ("viz/browser.py", "viz/browser/"),
    "torch": ("pipelines/detection/", "pipelines/flow/"),
    "torchvision": ("pipelines/detection/", "pipelines/flow/"),
    "onnxruntime": ("pipelines/detection/", "pipelines/flow/"),
}
LAZY = ("av", "open3d", "matplotlib", "evo", "filterpy", "gtsam", "meshcat", "torch", "onnxruntime")


def sources(*layers: str) -> list[Path]:
    return sorted(file for layer in layers or RANK for file in (ROOT / layer).rglob("*.py"))


def name_of(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of the modules that a source imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: a relative import"
            yield node.module or ""


def imports_when_loaded(tree: ast.Module) -> Iterator[str]:
    """The same without what stands in functions."""
    pending: list[ast.AST] = list(tree.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from imports(node)
        pending.extend(ast.iter_child_nodes(node))


def parse(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def test_the_layers_are_found() -> None:
    for layer in RANK:
        assert sources(layer), f"no sources in {layer}/"


@pytest.mark.parametrize("file", sources(), ids=name_of)
def test_imports_go_down_the_layers(file: Path) -> None:
    own = RANK[name_of(file).split("/")[0]]
    for module in imports(parse(file)):
        top = module.split(".")[0]
        assert RANK.get(top, -1) <= own, f"imports {module}"
        assert top not in ("tests", "notebooks"), f"imports {module}"


NOUNS = ("types", "object_types", "frame_observations", "shapes")


@pytest.mark.parametrize("name", NOUNS)
def test_types_import_numpy_and_each_other_alone(name: str) -> None:
    modules = set(imports(parse(ROOT / f"pipelines/{name}.py")))
    modules -= {f"pipelines.{noun}" for noun in NOUNS}
    tops = {module.split(".")[0] for module in modules}
    assert tops - set(sys.stdlib_module_names) == {"numpy"}


@pytest.mark.parametrize("file", sources(), ids=name_of)
def test_heavy_packages_stay_in_their_files(file: Path) -> None:
    for module in imports(parse(file)):
        top = module.split(".")[0]
        places = OWNERS.get(top)
        assert places is None or name_of(file).startswith(places), f"imports {module}"


@pytest.mark.parametrize("file", sources(), ids=name_of)
def test_heavy_packages_load_when_first_needed(file: Path) -> None:
    owned = {top for top, places in OWNERS.items() if name_of(file).startswith(places)}
    for module in imports_when_loaded(parse(file)):
        top = module.split(".")[0]
        assert top not in LAZY or top in owned, f"imports {module} when loaded"


@pytest.mark.parametrize("name", STDLIB_ONLY)
def test_set_up_and_help_need_the_standard_library_alone(name: str) -> None:
    for module in imports(parse(ROOT / "app" / f"{name}.py")):
        top = module.split(".")[0]
        known = top in sys.stdlib_module_names or top == "app" or module == "pipelines.errors"
        assert known, f"imports {module}"


@pytest.mark.parametrize("file", sources("pipelines", "viz"), ids=name_of)
def test_only_the_app_prints_and_exits(file: Path) -> None:
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in ("print", "exit", "quit", "sys.exit", "os._exit"), (
                f"line {node.lineno}: {called}()"
            )
        if isinstance(node, ast.Raise) and node.exc is not None:
            assert not ast.unparse(node.exc).startswith("SystemExit"), f"line {node.lineno}"


@pytest.mark.parametrize("file", sources(), ids=name_of)
def test_no_bare_except(file: Path) -> None:
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"line {node.lineno}: except without a type"


def test_the_import_finder_sees_what_it_should() -> None:
    code = "import a.b\nfrom c import d\nclass K:\n    import e\ndef f():\n    import g\n"
    tree = ast.parse(code)
    assert set(imports(tree)) == {"a.b", "c", "e", "g"}
    assert set(imports_when_loaded(tree)) == {"a.b", "c", "e"}
