"""Set-up: a `.venv` with the pinned packages of environment.txt, made once and then entered.

Owns the order of things, the lock and the choice of interpreter. Standard library only, since it
runs before anything is installed.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from app import installation, system_libraries
from app.environment import (
    CORE,
    DEVELOPMENT,
    NOTEBOOK,
    TORCH,
    Environment,
    SetupError,
    has_packages,
)
from app.installation import Say

_NEEDED_GB = {CORE: 2.5, DEVELOPMENT: 0.7, NOTEBOOK: 0.5, TORCH: 10.0}


def prepare(argv: Sequence[str], sections: Sequence[str] = (CORE,)) -> None:
    """Return when this process has the packages of `sections`; until then set up and re-execute.

    Raises SetupError with what to do where the machine lacks something.
    """
    if os.environ.get("DYOB_NO_SETUP") == "1":
        return
    environment = Environment.read()
    if not environment.is_current() and has_packages(environment.pins(sections)):
        _check_system_once(environment)
        return
    if not _is_sound(environment, sections):
        set_up(environment, sections)
        os.environ.pop("DYOB_ENTERED", None)
    elif environment.is_current():
        return
    enter(environment, argv)


def enter_if_ready(argv: Sequence[str]) -> None:
    """Re-execute in a finished `.venv`, if there is one and this is not it; never set up."""
    environment = Environment.read()
    if os.environ.get("DYOB_NO_SETUP") == "1" or environment.is_current():
        return
    if environment.is_ready([CORE]) and not has_packages(environment.pins([CORE])):
        enter(environment, argv)


def enter(environment: Environment, argv: Sequence[str]) -> None:
    """Replace this process by `.venv`'s Python with the same command line."""
    marker = str(os.getpid())  # stays the same through execv, and differs in child processes
    if os.environ.get("DYOB_ENTERED") == marker:
        raise SetupError(
            f"{environment.python} does not run as a virtual environment: "
            f"remove {environment.folder} and start again"
        )
    os.environ["DYOB_ENTERED"] = marker
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(environment.python, [str(environment.python), "-m", "app", *argv])


def set_up(environment: Environment, sections: Sequence[str]) -> None:
    """Make or complete `.venv` so that it holds `sections`; waits for a set-up already at work."""
    say = _speaker()
    _check_platform(environment)
    with _locked(environment, say) as lock:
        if _is_sound(environment, sections):
            return  # somebody else finished it meanwhile
        _ensure_system_libraries(environment, say, with_venv_module=True)
        held = environment.stamped()
        _check_disk(environment, [s for s in sections if s not in held])
        # Sections that were installed before stay part of the promise.
        sections = [s for s in environment.sections if s in sections or s in held]
        environment.stamp.unlink(missing_ok=True)
        installation.make_folder(environment, say)
        environment.unfinished.touch()
        installation.install(environment, sections, lock, say)
        _write_stamp(environment, sections)
        environment.unfinished.unlink()
        say("set-up finished")


def ensure_torch() -> None:
    """Install torch and torchvision where they are missing; returns when they can be imported.

    Only `.venv` is ever changed. Raises SetupError with the command to type for any other
    interpreter, and where DYOB_NO_SETUP=1 forbids it.
    """
    environment = Environment.read()
    pins = environment.pins([TORCH])
    if has_packages(pins):
        return
    if not environment.is_current() or os.environ.get("DYOB_NO_SETUP") == "1":
        raise SetupError(
            f"this needs torch, which this Python lacks: type '{sys.executable} -m pip install "
            f"{' '.join(pins)}' and start again"
        )
    set_up(environment, [CORE, TORCH])
    importlib.invalidate_caches()


def has_venv_module() -> bool:
    """Whether this Python can make virtual environments; Debian splits `ensurepip` off."""
    return all(importlib.util.find_spec(module) for module in ("venv", "ensurepip"))


def _is_sound(environment: Environment, sections: Sequence[str]) -> bool:
    if not environment.is_ready(sections):
        return False
    # From inside one can see what from outside cannot: the system's Python was replaced.
    return not environment.is_current() or environment.stamped().get("python") == _python_version()


def _python_version() -> str:
    return f"{sys.version_info.major}.{sys.version_info.minor}"


def _write_stamp(environment: Environment, sections: Sequence[str]) -> None:
    version = installation.python_version(environment)
    held = {"python": version, **{s: environment.digest(s) for s in sections}}
    temporary = environment.stamp.with_suffix(".new")
    temporary.write_text(json.dumps(held, indent=1), encoding="utf-8")
    temporary.replace(environment.stamp)


def _check_system_once(environment: Environment) -> None:
    """For an interpreter used as it is: libraries it cannot do without, and one try at Vulkan."""
    may_install = system_libraries.can_install() and not environment.system_log.exists()
    if system_libraries.missing_required() or (
        may_install and system_libraries.missing_rendering()
    ):
        _ensure_system_libraries(environment, _speaker())


def _ensure_system_libraries(
    environment: Environment, say: Say, with_venv_module: bool = False
) -> None:
    """Install what open3d needs from the system, as root on Debian; else say what to type."""
    required = system_libraries.missing_required()
    if with_venv_module and not has_venv_module():
        required["Python's modules venv and ensurepip"] = f"python{_python_version()}-venv"
    rendering = system_libraries.missing_rendering()
    if not required and not rendering:
        return
    if system_libraries.can_install():
        packages = [*required.values(), *rendering.values()]
        say(f"installing system packages: {' '.join(packages)}")
        if not system_libraries.install(packages, environment.system_log):
            say(f"that failed (log: {environment.system_log})")
        required = {what: package for what, package in required.items() if not _is_there(what)}
        rendering = system_libraries.missing_rendering()
    command = system_libraries.install_command([*required.values(), *rendering.values()])
    if required:
        raise SetupError(f"missing on this machine: {', '.join(required)}; type: {command}")
    if rendering:
        say(
            f"without {' and '.join(rendering)}, pictures are drawn by plain software splatting; "
            f"for better ones type: {command}"
        )


def _is_there(what: str) -> bool:
    if what in system_libraries.REQUIRED:
        return system_libraries.is_loadable(what)
    importlib.invalidate_caches()
    return has_venv_module()


def _check_platform(environment: Environment) -> None:
    if not sys.platform.startswith("linux"):
        raise SetupError(
            f"the set-up knows Linux only, and this is {sys.platform}: install the packages of "
            f"{environment.root / 'environment.txt'} yourself and set DYOB_NO_SETUP=1"
        )


def _check_disk(environment: Environment, sections: Sequence[str]) -> None:
    needed = sum(_NEEDED_GB.get(section, 0.0) for section in sections)
    free = shutil.disk_usage(environment.root).free / 1e9
    if free < needed:
        raise SetupError(
            f"the set-up needs {needed:.1f} GB in {environment.root} and {free:.1f} GB are free: "
            "make room and start again"
        )


@contextmanager
def _locked(environment: Environment, say: Say) -> Iterator[int]:
    """Hold the set-up's lock; yields its file descriptor."""
    import fcntl

    try:
        descriptor = os.open(environment.lock, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise SetupError(
            f"cannot write in {environment.root} ({error.strerror}): clone the repository to a "
            "folder of your own"
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another set-up is at work here: waiting for it")
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def _speaker() -> Say:
    """A function that prints a line with the time since now, to stderr."""
    started = time.monotonic()

    def say(text: str) -> None:
        sys.stderr.write(f"[set-up {time.monotonic() - started:4.0f} s] {text}\n")
        sys.stderr.flush()

    return say
