"""The set-up, on a folder of its own whose Python is a script that records what pip is asked."""

from __future__ import annotations

import fcntl
import http.server
import importlib.metadata
import os
import shutil
import subprocess
import threading
from pathlib import Path

import pytest

from app import bootstrap, installation, system_libraries
from app.environment import CORE, DEVELOPMENT, TORCH, Environment, SetupError

PINS = "# [core]\nfirst-package==1.0\n# [development]\nsecond-package==2.0\n# [torch]\ntorch==3.0\n"
# Stands for .venv/bin/python: answers the version, and takes notes of what pip is to install.
PYTHON = """\
#!/bin/sh
case "$*" in
  "-c "*) echo 3.77 ;;
  "-I -m pip --version") echo pip ;;
  "-I -m pip install "*)
    echo "$*" >> "{calls}"
    echo "Downloading first_package-1.0-py3-none-any.whl (105.2 MB)"
    echo "Installing collected packages: a, b, c"
    {ending} ;;
  *) exit 99 ;;
esac
"""


class Machine:
    """A repository root with an environment.txt, and a count of what the set-up does there."""

    def __init__(self, root: Path) -> None:
        self.root, self.calls, self.n_made, self.ending = root, root / "calls.txt", 0, "exit 0"
        self.entered: list[tuple[str, list[str]]] = []
        (root / "environment.txt").write_text(PINS)

    @property
    def environment(self) -> Environment:
        return Environment.read(self.root)

    @property
    def pip_calls(self) -> list[str]:
        return self.calls.read_text().splitlines() if self.calls.exists() else []

    def make_folder(self) -> None:
        self.n_made += 1
        folder = self.root / ".venv"
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "bin").mkdir(parents=True)
        self.write_python()

    def write_python(self) -> None:
        python = self.root / ".venv" / "bin" / "python"
        python.write_text(PYTHON.format(calls=self.calls, ending=self.ending))
        python.chmod(0o755)

    def change_pin(self) -> None:
        text = (self.root / "environment.txt").read_text()
        (self.root / "environment.txt").write_text(text.replace("==1.0", "==1.1"))


@pytest.fixture
def machine(tmp_path: Path, monkeypatch) -> Machine:
    machine = Machine(tmp_path)
    real_run = installation._run_quietly

    def run(command):
        if "venv" not in command:
            return real_run(command)
        machine.make_folder()
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(installation, "_run_quietly", run)
    read = Environment.read.__func__  # type: ignore[attr-defined]
    monkeypatch.setattr(
        Environment, "read", classmethod(lambda cls, root=tmp_path: read(cls, root))
    )
    monkeypatch.setattr(system_libraries, "missing_required", dict)
    monkeypatch.setattr(system_libraries, "missing_rendering", dict)
    monkeypatch.setattr(os, "execv", lambda path, argv: machine.entered.append((str(path), argv)))
    for name in ("DYOB_NO_SETUP", "DYOB_ENTERED", "DYOB_TORCH_INDEX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DYOB_ENTERED", "")
    return machine


def test_a_first_start_makes_installs_stamps_and_enters(machine, capsys) -> None:
    bootstrap.prepare(["demo", "--quiet"])
    assert machine.n_made == 1
    assert len(machine.pip_calls) == 1
    assert machine.pip_calls[0].endswith(" first-package==1.0")
    assert machine.environment.stamped() == {
        "python": "3.77",
        CORE: machine.environment.digest(CORE),
    }
    assert not machine.environment.unfinished.exists()
    python = str(machine.root / ".venv" / "bin" / "python")
    assert machine.entered == [(python, [python, "-m", "app", "demo", "--quiet"])]
    said = capsys.readouterr().err
    assert "downloading first_package 1.0, 105 MB" in said
    assert "unpacking 3 packages" in said


def test_the_log_holds_all_that_pip_said(machine) -> None:
    bootstrap.prepare([])
    assert "Installing collected packages: a, b, c" in machine.environment.log.read_text()


def test_a_second_start_only_enters(machine, capsys) -> None:
    for _ in range(2):
        bootstrap.prepare(["demo"])
        os.environ["DYOB_ENTERED"] = ""  # a new process
        said = capsys.readouterr().err
    assert (machine.n_made, len(machine.pip_calls), len(machine.entered)) == (1, 1, 2)
    assert said == ""


def test_changed_pins_are_installed_into_the_same_folder(machine) -> None:
    bootstrap.prepare([])
    machine.change_pin()
    bootstrap.prepare([])
    assert machine.n_made == 1
    assert machine.pip_calls[1].endswith(" first-package==1.1")
    assert machine.environment.is_ready([CORE])


def test_another_section_is_added_and_then_kept(machine) -> None:
    bootstrap.prepare([])
    bootstrap.prepare(["test"], (CORE, DEVELOPMENT))
    assert machine.pip_calls[1].endswith(" first-package==1.0 second-package==2.0")
    machine.change_pin()
    bootstrap.prepare([])
    assert machine.pip_calls[2].endswith(" first-package==1.1 second-package==2.0")
    assert machine.environment.is_ready([CORE, DEVELOPMENT])


@pytest.mark.parametrize(
    ("ending", "words"),
    [
        ("exit 3", "pip ended with code 3"),
        ("kill -9 $$", "pip was ended by signal 9"),
        ("echo 'OSError: No space left on device'; exit 1", "the disk is full"),
        ("echo 'NewConnectionError: no route'; exit 1", "the package index cannot be reached"),
    ],
)
def test_a_failed_pip_is_explained_and_the_next_start_begins_again(
    machine, capsys, ending, words
) -> None:
    machine.ending = ending
    with pytest.raises(SetupError, match=words) as raised:
        bootstrap.prepare([])
    assert str(machine.environment.log) in str(raised.value)
    assert "Installing collected packages" in capsys.readouterr().err
    assert machine.environment.stamped() == {}
    assert machine.environment.unfinished.exists()
    assert machine.entered == []

    machine.ending = "exit 0"
    bootstrap.prepare([])
    assert machine.n_made == 2
    assert "the last set-up did not finish: starting over" in capsys.readouterr().err
    assert machine.environment.is_ready([CORE])
    assert len(machine.entered) == 1


def test_an_interrupted_change_starts_over_too(machine) -> None:
    bootstrap.prepare([])
    machine.change_pin()
    machine.ending = "kill -9 $$"
    machine.write_python()
    with pytest.raises(SetupError):
        bootstrap.prepare([])
    machine.ending = "exit 0"
    bootstrap.prepare([])
    assert machine.n_made == 2
    assert machine.environment.is_ready([CORE])


def test_a_folder_whose_python_is_gone_is_made_anew(machine, capsys) -> None:
    bootstrap.prepare([])
    machine.environment.python.unlink()
    machine.environment.python.symlink_to(machine.root / "python-that-was-removed")
    bootstrap.prepare([])
    assert machine.n_made == 2
    assert "does not work any more: making it anew" in capsys.readouterr().err


def test_a_folder_that_somebody_else_made_is_completed(machine) -> None:
    machine.make_folder()
    bootstrap.prepare([])
    assert machine.n_made == 1  # by the line above
    assert machine.environment.is_ready([CORE])


def test_a_set_up_waits_for_the_one_at_work(machine, capsys) -> None:
    environment = machine.environment
    machine.make_folder()
    lock = os.open(environment.lock, os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)
    waiting = threading.Event()

    def say(text: str) -> None:
        assert text == "another set-up is at work here: waiting for it"
        waiting.set()

    def wait() -> None:
        with bootstrap._locked(environment, say):
            assert environment.is_ready([CORE])

    second = threading.Thread(target=wait)
    second.start()
    assert waiting.wait(10)
    bootstrap._write_stamp(environment, [CORE])  # the first one finishes
    os.close(lock)
    second.join(10)
    assert not second.is_alive()
    bootstrap.set_up(environment, [CORE])
    assert machine.pip_calls == []


def test_pip_inherits_the_lock(machine) -> None:
    """So that a pip which outlives its set-up keeps the next one out."""
    held = machine.root / "held.txt"
    machine.ending = f'ls -l /proc/$$/fd > "{held}"; exit 0'
    bootstrap.prepare([])
    assert str(machine.environment.lock) in held.read_text()


def test_no_setup_changes_nothing(machine, monkeypatch) -> None:
    monkeypatch.setenv("DYOB_NO_SETUP", "1")
    bootstrap.prepare([])
    bootstrap.enter_if_ready([])
    assert (machine.n_made, machine.entered) == (0, [])


def test_a_python_with_all_packages_is_used_as_it_is(machine) -> None:
    version = importlib.metadata.version("pytest")
    (machine.root / "environment.txt").write_text(f"# [core]\npytest=={version}\n")
    bootstrap.prepare([])
    assert (machine.n_made, machine.entered) == (0, [])
    assert not machine.environment.lock.exists()


def test_entering_twice_in_one_process_is_an_error_not_a_loop(machine) -> None:
    bootstrap.prepare([])
    with pytest.raises(SetupError, match="does not run as a virtual environment"):
        bootstrap.prepare([])


def test_entering_if_ready_never_sets_up(machine) -> None:
    bootstrap.enter_if_ready(["doctor"])
    assert (machine.n_made, machine.entered) == (0, [])
    bootstrap.set_up(machine.environment, [CORE])
    bootstrap.enter_if_ready(["doctor"])
    assert machine.entered[0][1][1:] == ["-m", "app", "doctor"]


def test_a_replaced_system_python_is_noticed_from_inside(machine, monkeypatch) -> None:
    bootstrap.prepare([])
    monkeypatch.setattr("sys.prefix", str(machine.root / ".venv"))
    assert machine.environment.stamped()["python"] == "3.77"  # and this is another one
    bootstrap.prepare([])
    assert len(machine.pip_calls) == 2


def test_a_sound_folder_is_not_left(machine, monkeypatch) -> None:
    bootstrap.prepare([])
    monkeypatch.setattr("sys.prefix", str(machine.root / ".venv"))
    monkeypatch.setattr(bootstrap, "_python_version", lambda: "3.77")
    bootstrap.prepare([])
    assert (len(machine.pip_calls), len(machine.entered)) == (1, 1)


def test_missing_libraries_without_root_give_the_one_command(machine, monkeypatch) -> None:
    monkeypatch.setattr(system_libraries, "missing_required", lambda: {"libEGL.so.1": "libegl1"})
    monkeypatch.setattr(system_libraries, "missing_rendering", lambda: {"libv": "libvulkan1"})
    monkeypatch.setattr(system_libraries, "can_install", lambda: False)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(SetupError) as raised:
        bootstrap.prepare([])
    assert str(raised.value) == (
        "missing on this machine: libEGL.so.1; type: sudo apt-get update && sudo apt-get install "
        "-y --no-install-recommends libegl1 libvulkan1"
    )
    assert machine.n_made == 0


def test_missing_vulkan_alone_is_a_sentence(machine, monkeypatch, capsys) -> None:
    monkeypatch.setattr(system_libraries, "missing_rendering", lambda: {"libv": "libvulkan1"})
    monkeypatch.setattr(system_libraries, "can_install", lambda: False)
    bootstrap.prepare([])
    assert "without libv, pictures are drawn by plain software splatting" in capsys.readouterr().err
    assert machine.environment.is_ready([CORE])


@pytest.mark.parametrize("succeeds", [True, False])
def test_root_installs_libraries_and_the_venv_module(machine, monkeypatch, succeeds) -> None:
    asked: list[str] = []

    def install(packages, log) -> bool:
        asked.extend(packages)
        return succeeds

    done = lambda value: {} if asked and succeeds else value  # noqa: E731
    missing = {"libEGL.so.1": "libegl1"}
    monkeypatch.setattr(system_libraries, "missing_required", lambda: dict(done(missing)))
    monkeypatch.setattr(system_libraries, "missing_rendering", lambda: done({"v": "libvulkan1"}))
    monkeypatch.setattr(system_libraries, "is_loadable", lambda file: bool(asked) and succeeds)
    monkeypatch.setattr(system_libraries, "can_install", lambda: True)
    monkeypatch.setattr(system_libraries, "install", install)
    monkeypatch.setattr(bootstrap, "has_venv_module", lambda: bool(asked) and succeeds)
    monkeypatch.setattr(bootstrap, "_python_version", lambda: "3.11")
    if succeeds:
        bootstrap.prepare([])
        assert machine.environment.is_ready([CORE])
    else:
        with pytest.raises(SetupError, match=r"missing on this machine: libEGL\.so\.1, Python's"):
            bootstrap.prepare([])
    assert asked == ["libegl1", "python3.11-venv", "libvulkan1"]


def test_too_small_a_disk_is_said_before_anything_is_made(machine, monkeypatch) -> None:
    usage = shutil.disk_usage(machine.root)._replace(free=10**9)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(SetupError, match=r"needs 2.5 GB in .* and 1.0 GB are free"):
        bootstrap.prepare([])
    assert machine.n_made == 0


def test_a_root_that_cannot_be_written_is_one_sentence(machine) -> None:
    machine.environment.lock.mkdir()
    with pytest.raises(SetupError, match="cannot write in"):
        bootstrap.prepare([])


def test_other_systems_are_told_what_to_do(machine, monkeypatch) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    with pytest.raises(SetupError, match="knows Linux only, and this is darwin"):
        bootstrap.prepare([])


def test_torch_is_never_forced_on_another_interpreter(machine) -> None:
    with pytest.raises(SetupError, match=r"-m pip install torch==3.0' and start again"):
        bootstrap.ensure_torch()
    assert machine.pip_calls == []


def test_torch_joins_what_is_installed(machine, monkeypatch, capsys) -> None:
    bootstrap.prepare([])
    monkeypatch.setattr("sys.prefix", str(machine.root / ".venv"))
    monkeypatch.setattr(installation, "has_gpu", lambda: False)
    bootstrap.ensure_torch()
    assert machine.pip_calls[1].endswith(" first-package==1.0 torch==3.0")
    assert machine.environment.is_ready([CORE, TORCH])
    assert "torch: about 4 GB with GPU support" in capsys.readouterr().err


@pytest.fixture
def index():
    """A package index that answers, on the loopback address."""
    handler = http.server.SimpleHTTPRequestHandler
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def test_the_cpu_build_comes_from_an_index_that_answers(monkeypatch, index) -> None:
    said: list[str] = []
    monkeypatch.setenv("DYOB_TORCH_INDEX", index)
    monkeypatch.setattr(installation, "has_gpu", lambda: False)
    assert installation._torch_index([CORE, TORCH], said.append) == ["--extra-index-url", index]
    assert "the CPU build" in said[0]
    assert installation._torch_index([CORE], said.append) == []
    monkeypatch.setattr(installation, "has_gpu", lambda: True)
    assert installation._torch_index([TORCH], said.append) == []
    assert "since there is a GPU" in said[1]


@pytest.mark.parametrize("address", ["http://127.0.0.1:1/", "no address"])
def test_an_index_that_does_not_answer_is_passed_over(monkeypatch, address) -> None:
    said: list[str] = []
    monkeypatch.setenv("DYOB_TORCH_INDEX", address)
    monkeypatch.setattr(installation, "has_gpu", lambda: False)
    assert installation._torch_index([TORCH], said.append) == []
    assert "does not answer" in said[0]
