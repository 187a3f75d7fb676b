"""The command line's words: examples that parse, errors in one sentence, help without set-up."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from app import arguments, bootstrap, cli

HEAVY = ("numpy", "scipy", "cv2", "open3d", "rich", "yaml", "matplotlib", "gtsam", "evo", "logging")


def all_examples() -> list[str]:
    lines = [line for verb in cli.VERBS.values() for line in verb.examples.splitlines()]
    first = [line for line in cli._FIRST_EXAMPLES.splitlines() if not line.startswith("VERB")]
    return lines + first


@pytest.fixture
def no_set_up(monkeypatch):
    def fail(*arguments):
        raise AssertionError("set-up was started")

    monkeypatch.setattr(bootstrap, "prepare", fail)
    monkeypatch.setattr(bootstrap, "enter_if_ready", fail)


@pytest.mark.parametrize("line", all_examples())
def test_every_example_parses(line: str) -> None:
    words = shlex.split(line.replace(">", "#"), comments=True)
    arguments, extra = cli.build_parser().parse_known_args(words)
    assert arguments.verb == words[0]
    assert not extra or arguments.verb == "test"


@pytest.mark.parametrize("argv", [[], ["--help"], *([verb, "--help"] for verb in cli.VERBS)])
def test_help_begins_with_examples_and_never_sets_up(no_set_up, capsys, argv) -> None:
    try:
        assert cli.main(argv) == 0
    except SystemExit as left:
        assert left.code == 0
    said = capsys.readouterr().out
    assert said.startswith("Examples:\n  python3 -m app ")
    assert said.index("Examples:") < said.index("usage:")


@pytest.mark.parametrize("argv", [["--help"], ["run", "--help"], []])
def test_help_imports_nothing_heavy(repository: Path, argv) -> None:
    script = (
        "import sys, runpy\n"
        f"sys.argv = ['app', *{argv!r}]\n"
        "try: runpy.run_module('app', run_name='__main__')\n"
        "except SystemExit as left: assert not left.code, left.code\n"
        "print('LOADED', *sorted(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=repository, capture_output=True, text=True, check=True
    )
    loaded = done.stderr.split("LOADED")[1].split()
    assert "app.cli" in loaded
    assert not [name for name in HEAVY if name in loaded]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["rnu", "x"], "invalid choice: 'rnu'"),
        (["run"], "required: PATH"),
        (["run", "x", "--frame", "3"], "'run' does not know --frame 3"),
        (["run", "x", "--frames", "0"], "--frames: expected a whole number of at least 1"),
        (["run", "x", "--stride", "-1"], "--stride: expected a whole number, found '-1'"),
        (["run", "x", "--start", "a"], "--start: expected a whole number, found 'a'"),
        (["render", "--size", "1280"], "expected WIDTHxHEIGHT as in 1280x720, found '1280'"),
        (["render", "--size", "0x720"], "expected sides of 160 to 8192 pixels"),
        (["render", "--size", "99999x720"], "expected sides of 160 to 8192 pixels"),
        (["render", "--view", "side"], "invalid choice: 'side'"),
        (["eval", "a", "b"], "'eval' does not know b"),
    ],
)
def test_wrong_words_are_one_sentence_and_start_no_set_up(no_set_up, capsys, argv, words) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(argv)
    said = capsys.readouterr().err
    assert left.value.code == 2
    assert words in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("name", cli.VERBS)
def test_every_verb_has_its_function(name: str) -> None:
    module, _, function = cli.VERBS[name].function.partition(":")
    assert callable(getattr(import_module(module), function))


def test_the_verb_gets_its_flags_after_its_set_up(monkeypatch) -> None:
    seen = []
    monkeypatch.setattr(bootstrap, "prepare", lambda argv, sections: seen.append(sections))
    monkeypatch.setattr("app.runs.run", lambda arguments: seen.append(arguments) or 7)
    argv = ["run", "data", "--frames", "5", "--set", "a.b=1", "--set", "c.d=2"]
    assert cli.main(argv) == 7
    sections, arguments = seen
    assert sections == ("core",)
    assert (arguments.path, arguments.frames, arguments.stride) == ("data", 5, 1)
    assert arguments.overrides == ["a.b=1", "c.d=2"]


@pytest.mark.parametrize("words", [[], ["-k", "config", "-x"], ["tests/app", "-k", "config"]])
def test_what_follows_test_goes_to_pytest_in_order(monkeypatch, words) -> None:
    seen = []
    monkeypatch.setattr(bootstrap, "prepare", lambda argv, sections: seen.append(sections))
    monkeypatch.setattr("app.checks.test", lambda arguments: seen.append(arguments) or 0)
    cli.main(["test", "--debug", *words])
    assert seen[0] == ("core", "development", "notebook", "torch")  # else their tests would skip
    assert seen[1].pytest_arguments == words


def test_a_verb_runs_in_a_process_of_its_own(repository: Path) -> None:
    environment = {**os.environ, "DYOB_NO_SETUP": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "app", "config", "--set", "orb.n_features=many"],
        cwd=repository,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("dyob-slam: orb.n_features: expected a whole number")


def test_render_offers_what_the_renderer_can_draw() -> None:
    from viz.render import VIEW_NAMES
    from viz.style import BACKGROUNDS

    assert arguments.VIEWS == VIEW_NAMES
    for background in BACKGROUNDS:
        cli.build_parser().parse_args(["render", "--background", background])


@pytest.mark.parametrize("line", ["--view top iso", "--view top --view iso"])
def test_views_come_as_a_list_or_one_by_one(line: str) -> None:
    arguments = cli.build_parser().parse_args(["render", *line.split()])
    assert arguments.view == ["top", "iso"]
    assert arguments.video is None
    assert cli.build_parser().parse_args(["render", "x", "--video"]).video == "chase"
