"""`doctor`: whether this machine, and a data folder if one is given, are fit, in words.

Owns the findings and their wording. Works before any set-up, so heavy imports come last.
"""

from __future__ import annotations

import os
import platform
import shutil
import sys
import tomllib
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from app import system_libraries
from app.bootstrap import has_venv_module
from app.environment import CORE, DEVELOPMENT, NOTEBOOK, TORCH, Environment, missing_packages


class Verdict(Enum):
    """Whether a finding is good, worth knowing, or stands in the way."""

    OK = "ok"
    NOTE = "note"
    UNFIT = "UNFIT"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    verdict: Verdict
    subject: str
    words: str


def doctor(arguments: Namespace) -> int:
    """Print the findings; 1 if one of them stands in the way, else 0."""
    findings = []
    for finding in _all_findings(arguments):
        findings.append(finding)
        print(f"{finding.verdict.value:<6} {finding.subject:<18} {finding.words}", flush=True)
    unfit = [f.subject for f in findings if f.verdict is Verdict.UNFIT]
    what = "this machine" + (" and these data" if arguments.path else "")
    print(f"\nNot fit yet: {', '.join(unfit)}." if unfit else f"\nFit: {what}.")
    return 1 if unfit else 0


def _all_findings(arguments: Namespace) -> Iterator[Finding]:
    environment = Environment.read()
    yield from machine(environment)
    if arguments.path is None:
        return
    if missing_packages(environment.pins([CORE])) and not _can_import(("numpy", "cv2", "open3d")):
        yield Finding(
            Verdict.UNFIT,
            "data",
            "cannot be read before the packages are there: 'python3 -m app demo' brings them",
        )
        return
    yield from data(arguments.path, arguments.dataset, arguments.sequence)


def machine(environment: Environment) -> Iterator[Finding]:
    """What of this machine matters: program, Python, packages, libraries, processor, disk."""
    yield Finding(Verdict.OK, "DyOb-SLAM", f"{_version(environment)} in {environment.root}")
    yield Finding(Verdict.OK, "Python", f"{platform.python_version()}, {sys.executable}")
    yield from _packages(environment)
    yield from _libraries()
    linux = sys.platform.startswith("linux")
    memory = f", {_memory_gb():.0f} GB memory" if linux else ""
    yield Finding(
        Verdict.OK if linux else Verdict.NOTE,
        "machine",
        f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPUs{memory}",
    )
    free = shutil.disk_usage(environment.root).free / 1e9
    ready = environment.is_ready([CORE])
    enough = free > (0.5 if ready else 3.0)
    yield Finding(Verdict.OK if enough else Verdict.UNFIT, "disk", f"{free:.1f} GB free")


def _version(environment: Environment) -> str:
    with (environment.root / "pyproject.toml").open("rb") as file:
        return str(tomllib.load(file)["project"]["version"])


def _memory_gb() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9


def _packages(environment: Environment) -> Iterator[Finding]:
    set_up_is_off = os.environ.get("DYOB_NO_SETUP") == "1"
    for section in (CORE, DEVELOPMENT, NOTEBOOK, TORCH):
        pins = environment.pins([section])
        missing = missing_packages(pins)
        if not missing:
            words = ", ".join(pin.replace("==", " ") for pin in pins)
            yield Finding(Verdict.OK, f"packages: {section}", words)
            continue
        found = ", ".join(_lacking(pin, have) for pin, have in missing.items())
        if section == CORE and set_up_is_off:
            words = f"DYOB_NO_SETUP=1 is set, and this Python lacks {found}"
            absent = "nothing" in missing.values()
            yield Finding(Verdict.UNFIT if absent else Verdict.NOTE, f"packages: {section}", words)
        elif section == CORE:
            words = "not set up yet; 'python3 -m app demo' does it"
            yield Finding(Verdict.NOTE, f"packages: {section}", words)
        else:
            who = f"'python3 -m app {'notebook' if section == NOTEBOOK else 'test'}'"
            who += " or what first needs them" if section == TORCH else ""
            words = f"not installed; {who} brings them"
            yield Finding(Verdict.NOTE, f"packages: {section}", words)
    if not has_venv_module():
        name = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
        words = f"this Python cannot make virtual environments{_remedy([name])}"
        yield Finding(_if_missing(), "venv", words)


def _lacking(pin: str, found: str) -> str:
    wanted = pin.replace("==", " ")
    return wanted if found == "nothing" else f"{wanted} (it has {found})"


def _libraries() -> Iterator[Finding]:
    required, rendering = system_libraries.missing_required(), system_libraries.missing_rendering()
    if required:
        words = f"missing {', '.join(required)}{_remedy(list(required.values()))}"
        yield Finding(_if_missing(), "system libraries", words)
    else:
        yield Finding(Verdict.OK, "system libraries", ", ".join(system_libraries.REQUIRED))
    if rendering:
        words = (
            f"missing {' and '.join(rendering)}: pictures are drawn by plain software splatting"
            f"{_remedy(list(rendering.values()))}"
        )
        yield Finding(Verdict.NOTE, "Vulkan", words)
    else:
        drivers = ", ".join(file.stem for file in system_libraries.vulkan_drivers())
        yield Finding(Verdict.OK, "Vulkan", f"drivers: {drivers}")


def _set_up_installs() -> bool:
    return system_libraries.can_install() and os.environ.get("DYOB_NO_SETUP") != "1"


def _if_missing() -> Verdict:
    """What the set-up will install by itself is only a note."""
    return Verdict.NOTE if _set_up_installs() else Verdict.UNFIT


def _remedy(packages: Sequence[str]) -> str:
    if _set_up_installs():
        return f"; the set-up installs {', '.join(packages)}"
    return f"; on Debian type: {system_libraries.install_command(packages)}"


def _can_import(names: Sequence[str]) -> bool:
    from importlib.util import find_spec

    return all(find_spec(name) is not None for name in names)


def data(path: str, dataset: str | None, name: str | None) -> Iterator[Finding]:
    """What of a data folder matters: its layout, what its frames hold, truth."""
    from app import console

    with console.warnings():
        yield from _sequence(path, dataset, name)


def _sequence(path: str, dataset: str | None, name: str | None) -> Iterator[Finding]:
    from pipelines.datasets import open_sequence
    from pipelines.errors import DyObError

    try:
        sequence = open_sequence(path, dataset, name)
    except DyObError as error:
        yield Finding(Verdict.UNFIT, "layout", str(error))
        return
    camera = sequence.camera
    yield Finding(Verdict.OK, "layout", f"{sequence.dataset}, sequence {sequence.name}")
    kind = "RGB-D" if camera.is_rgbd else f"baseline {camera.baseline_m * 1000:.0f} mm"
    words = f"{camera.width}x{camera.height}, focal length {camera.fx:.1f} px, {kind}"
    yield Finding(Verdict.OK, "camera", words)
    yield _frame_count(sequence)
    if len(sequence) > 0:
        yield from _frames(sequence)
    yield _truth(sequence)


def _frame_count(sequence: Any) -> Finding:
    n = len(sequence)
    if n < 2:
        return Finding(Verdict.UNFIT, "frames", f"{n}; a trajectory needs at least two")
    seconds = float(sequence.timestamps_s[-1] - sequence.timestamps_s[0])
    rate = f" at {(n - 1) / seconds:.1f} fps" if seconds > 0 else ""
    return Finding(Verdict.OK, "frames", f"{n}, {seconds:.1f} s{rate}")


def _frames(sequence: Any) -> Iterator[Finding]:
    from pipelines.errors import DyObError

    # The first frame cannot have flow from the one before it, so the last one tells of flow.
    for index in dict.fromkeys((0, len(sequence) - 1)):
        try:
            frame = sequence.read(index)
        except DyObError as error:
            yield Finding(Verdict.UNFIT, f"frame {index}", str(error))
            continue
        yield _frame(frame)


def _frame(frame: Any) -> Finding:
    import numpy as np

    parts = ["grey image" if frame.image.ndim == 2 else "colour image"]
    if frame.image.max() == 0:
        parts.append("BLACK")
    if frame.image_right is not None:
        parts.append("right image")
    share = 0.0
    if frame.depth_m is not None:
        known = frame.depth_m[np.isfinite(frame.depth_m)]
        share = known.size / frame.depth_m.size
        reach = f", {known.min():.1f} to {known.max():.1f} m" if known.size else ""
        parts.append(f"depth at {share:.0%} of the pixels{reach}")
    if frame.flow_prev_to_curr_px is not None:
        parts.append("flow")
    if frame.instance_labels is not None:
        n = len(np.unique(frame.instance_labels[frame.instance_labels > 0]))
        classes = ", ".join(sorted(set((frame.instance_classes or {}).values())))
        parts.append(f"masks of {n}" + (f" ({classes})" if classes else ""))
    subject = f"frame {frame.index}"
    if frame.image_right is None and share == 0.0:
        words = f"{', '.join(parts)}: neither depth nor a right image, and one of them is needed"
        return Finding(Verdict.UNFIT, subject, words)
    return Finding(Verdict.OK, subject, ", ".join(parts))


def _truth(sequence: Any) -> Finding:
    from pipelines.errors import DyObError

    try:
        truth = sequence.ground_truth()
    except DyObError as error:
        return Finding(Verdict.UNFIT, "ground truth", str(error))
    if truth is None:
        return Finding(Verdict.NOTE, "ground truth", "none, so there will be no errors to show")
    objects = "" if truth.objects is None else f", {len(set(truth.objects.object_id))} objects"
    return Finding(Verdict.OK, "ground truth", f"{len(truth.timestamps_s)} poses{objects}")
