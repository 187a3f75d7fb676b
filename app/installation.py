"""The writing part of the set-up: a virtual environment, pip, and which build of torch.

Owns the calls to venv and pip, and the words for what goes wrong in them. Standard library only.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

from app.environment import TORCH, Environment, SetupError

_NEWEST_TESTED = (3, 13)
Say = Callable[[str], None]


def make_folder(environment: Environment, say: Say) -> None:
    """A `.venv` whose pip works. One that was left unfinished or is broken is made anew.

    Packages of an interrupted pip can look installed and lack files, hence no patching up.
    """
    if environment.folder.exists():
        if environment.unfinished.exists():
            say("the last set-up did not finish: starting over")
        elif _has_pip(environment):
            return
        else:
            say(f"{environment.folder} does not work any more: making it anew")
    say(f"making the virtual environment {environment.folder}")
    environment.unfinished.touch()
    base = getattr(sys, "_base_executable", None) or sys.executable
    made = _run_quietly([base, "-I", "-m", "venv", "--clear", environment.folder])
    if made.returncode != 0:
        raise SetupError(
            f"'{base} -m venv' failed, so there is no virtual environment: "
            f"{' '.join((made.stdout + made.stderr).split())}"
        )


def python_version(environment: Environment) -> str:
    """Version x.y of the Python in `.venv`."""
    script = "import sys; print('%d.%d' % sys.version_info[:2])"
    return _run_quietly([environment.python, "-c", script]).stdout.strip()


def _has_pip(environment: Environment) -> bool:
    try:
        return _run_quietly([environment.python, "-I", "-m", "pip", "--version"]).returncode == 0
    except OSError:
        return False


def _run_quietly(command: Sequence[str | Path]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


def install(environment: Environment, sections: Sequence[str], lock: int, say: Say) -> None:
    """Have pip put the pins of `sections` into `.venv`; raises SetupError where it fails.

    `lock` is the file descriptor of the set-up's lock.
    """
    pins = environment.pins(sections)
    say(f"installing {len(pins)} packages and what they need (log: {environment.log})")
    options = ["--no-input", "--disable-pip-version-check", "--progress-bar", "off"]
    # Most of what gets installed is never imported: it is compiled when it is.
    options += ["--no-compile", *_torch_index(sections, say)]
    # -I: neither PYTHONPATH nor the user's own packages may stand in for a pin.
    command = [str(environment.python), "-I", "-m", "pip", "install", *options, *pins]
    unwanted = ("PIP_USER", "PIP_TARGET", "PIP_PREFIX", "PIP_REQUIRE_VIRTUALENV")
    variables = {k: v for k, v in os.environ.items() if k not in unwanted}
    with environment.log.open("a", encoding="utf-8") as log:
        log.write(f"\n$ {' '.join(command)}\n")
        # pip inherits the lock: should this process die, the next set-up waits for that pip.
        with subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=variables,
            pass_fds=(lock,),
        ) as pip:
            assert pip.stdout is not None
            for line in pip.stdout:
                log.write(line)
                news = _news(line)
                if news:
                    say(news)
    if pip.returncode != 0:
        raise SetupError(_explain_pip(environment, pip.returncode))


def _news(line: str) -> str:
    """What of pip's output is worth a line: large downloads, and the start of unpacking."""
    download = re.match(r"\s*Downloading (\S+?)-(\d[^-]*)-\S+ \((\d+)[.\d]* MB\)", line)
    if download and int(download[3]) >= 20:
        return f"downloading {download[1]} {download[2]}, {download[3]} MB"
    if line.startswith("Installing collected packages:"):
        return f"unpacking {line.count(',') + 1} packages"
    return ""


def _explain_pip(environment: Environment, code: int) -> str:
    lines = environment.log.read_text(encoding="utf-8", errors="replace").splitlines()
    text = "\n".join(lines[-40:])
    if "No space left" in text:
        reason = "the disk is full"
    elif "No matching distribution" in text and sys.version_info[:2] > _NEWEST_TESTED:
        newest = ".".join(map(str, _NEWEST_TESTED))
        reason = f"packages are missing for this new a Python; use one from 3.11 to {newest}"
    elif re.search(r"NewConnectionError|NameResolutionError|ConnectTimeout|Read timed out", text):
        reason = "the package index cannot be reached; is there a network?"
    elif code < 0:
        reason = f"pip was ended by signal {-code}"
    else:
        reason = f"pip ended with code {code}"
    tail = "\n".join(f"    {line[:160]}" for line in lines[-8:])
    sys.stderr.write(f"{tail}\n")
    return f"installing the packages failed: {reason} (all of pip's words: {environment.log})"


def _torch_index(sections: Sequence[str], say: Say) -> list[str]:
    """pip's options for the CPU build of torch, where that is the right one and can be had."""
    if TORCH not in sections:
        return []
    index = os.environ.get("DYOB_TORCH_INDEX")
    if has_gpu():
        say("torch: the build with GPU support, since there is a GPU")
    elif not index:
        say("torch: about 4 GB with GPU support; DYOB_TORCH_INDEX=URL names an index of CPU builds")
    elif not _answers(index):
        say(f"torch: {index} does not answer, so the default index: about 4 GB with GPU support")
    else:
        say(f"torch: the CPU build, from {index}, since there is no GPU")
        return ["--extra-index-url", index]
    return []


def has_gpu() -> bool:
    return Path("/proc/driver/nvidia/version").exists() or Path("/dev/nvidia0").exists()


def _answers(url: str, timeout_s: float = 5.0) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=timeout_s) as reply:
            return bool(reply.status < 400)
    except (OSError, ValueError):
        return False
