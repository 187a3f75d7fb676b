"""The shared libraries that open3d needs from the operating system: found, named, installed.

Owns the table library -> Debian package. Standard library only; knows no Python packages.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

REQUIRED = {  # without these `import open3d` fails
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
VULKAN_LOADER = ("libvulkan.so.1", "libvulkan1")
VULKAN_DRIVERS = "mesa-vulkan-drivers"
BROWSER = "chromium"  # that the tests open the pages in; a program and a package of one name
_DRIVER_FOLDERS = (
    "/usr/local/etc/vulkan/icd.d",
    "/usr/local/share/vulkan/icd.d",
    "/etc/vulkan/icd.d",
    "/usr/share/vulkan/icd.d",
)


def is_loadable(file: str) -> bool:
    """Whether the dynamic loader finds the shared library `file`, wherever it lies."""
    try:
        ctypes.CDLL(file)
    except OSError:
        return False
    return True


def missing_required() -> dict[str, str]:
    """Library -> Debian package, of those that open3d cannot be imported without."""
    return {file: package for file, package in REQUIRED.items() if not is_loadable(file)}


def missing_rendering() -> dict[str, str]:
    """Library or driver -> Debian package, of those that off-screen rendering needs."""
    file, package = VULKAN_LOADER
    missing = {} if is_loadable(file) else {file: package}
    if not vulkan_drivers():
        missing["a Vulkan driver"] = VULKAN_DRIVERS
    return missing


def vulkan_drivers() -> list[Path]:
    """The driver descriptions that the Vulkan loader would read, which may be none."""
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if named:
        return [Path(file) for file in named.split(os.pathsep) if Path(file).is_file()]
    return [file for folder in _DRIVER_FOLDERS for file in sorted(Path(folder).glob("*.json"))]


def browser() -> str | None:
    """Path of the browser that the tests drive, or None."""
    return shutil.which(BROWSER)


def can_install() -> bool:
    """Whether this process may install Debian packages: root on a Debian-like system."""
    is_debian_like = shutil.which("apt-get") is not None and Path("/etc/debian_version").exists()
    return is_debian_like and os.geteuid() == 0


def install_command(packages: Sequence[str]) -> str:
    """The one command that a person types to install Debian `packages`."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    names = " ".join(packages)
    return f"{sudo}apt-get update && {sudo}apt-get install -y --no-install-recommends {names}"


def install(packages: Sequence[str], log: Path) -> bool:
    """Install Debian `packages` as root; the output goes to the end of `log`. True on success."""
    # A minimal image has no package lists, and old lists name files that are gone: then update.
    if _lists_are_there() and _apt_get(_install_arguments(packages), log):
        return True
    return _apt_get(["update"], log) and _apt_get(_install_arguments(packages), log)


def _install_arguments(packages: Sequence[str]) -> list[str]:
    return ["install", "-y", "--no-install-recommends", *packages]


def _lists_are_there() -> bool:
    return any(Path("/var/lib/apt/lists").glob("*_Packages*"))


def _apt_get(arguments: Sequence[str], log: Path) -> bool:
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    command = ["apt-get", "-o", "DPkg::Lock::Timeout=300", *arguments]
    with log.open("ab") as output:
        output.write(f"\n$ {' '.join(command)}\n".encode())
        output.flush()
        finished = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            check=False,
        )
    return finished.returncode == 0
