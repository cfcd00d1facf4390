"""Look at the machine and judge what it will do well, slowly, or not at all."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from pathlib import Path

from stages.doctor.capture_check import check_capture
from stages.doctor.libraries import CORE, OPTIONAL, Check, try_all, versions
from stages.doctor.machine import Machine, look
from stages.shared.capture.open_capture import detect_format, open_capture
from stages.shared.errors import GwError
from stages.shared.report import SILENT, Report

_GIB = 1 << 30
_NEEDED_MEMORY = 2 * _GIB
_NEEDED_DISK = 2 * _GIB
_NEEDED = ("torch", "open3d")  # nothing goes without; pymeshlab has a fallback, video a still


@dataclass(frozen=True)
class Diagnosis:
    """Everything that was found.

    Attributes:
        version: of gw. python: version. libraries: name to version or None. machine, checks: see there.
        slow: what will work, but slowly, and what to do about it. broken: what will not work.
    """

    version: str | None
    python: str
    libraries: dict[str, str | None]
    machine: Machine
    checks: list[Check]
    slow: list[str]
    broken: list[str]


def run(folder: Path, report: Report = SILENT) -> Diagnosis:
    """Look at this machine and at the disk that holds `folder`; nothing is kept."""
    report.step("looking at the machine")
    machine = look(folder)
    report.step("trying the libraries")
    checks = try_all()
    libraries = versions(CORE + OPTIONAL)
    slow, broken = judge(machine, checks, libraries)
    version = versions(("gaussian-wardrobe",))["gaussian-wardrobe"]
    return Diagnosis(version, platform.python_version(), libraries, machine, checks, slow, broken)


def is_capture(folder: Path) -> bool:
    """Whether a folder holds a capture in a layout that can be read."""
    try:
        detect_format(folder)
    except (GwError, OSError):
        return False
    return True


def check_folder(folder: Path, report: Report = SILENT) -> list[str]:
    """What is wrong with the capture in a folder; errors as `open_capture`."""
    return check_capture(open_capture(folder, poses_needed=False), report)


def judge(
    machine: Machine, checks: list[Check], libraries: dict[str, str | None]
) -> tuple[list[str], list[str]]:
    """What will be slow, and what is broken, each a sentence with its cure."""
    failed = {check.name: check.said for check in checks if not check.works}
    slow, broken = [], []
    for name in CORE:
        if libraries.get(name) is None:
            broken.append(f"{name} is not installed: install gw again with its dependencies.")
    for name in _NEEDED:
        if name in failed:
            cure = "" if "apt install" in failed[name] else " Install it again."
            broken.append(f"{name} does not work here: {failed[name].rstrip('.')}.{cure}")
    if not machine.writable:
        broken.append("Nothing can be written here: choose another folder, or mend its permissions.")
    if machine.free_memory_bytes < _NEEDED_MEMORY:
        slow.append(
            f"{machine.free_memory_bytes / _GIB:.1f} GiB of memory are free, 2 are wanted: use --preset tiny."
        )
    if machine.free_disk_bytes < _NEEDED_DISK:
        free = machine.free_disk_bytes / _GIB
        slow.append(f"{free:.1f} GiB of disk are free, a demo takes 2: free some.")
    if "cuda" in failed:
        slow.append(
            f"Training runs on the processor ({failed['cuda']}): preset draft fits it, paper does not."
        )
    if "pymeshlab" in failed:
        slow.append(f"pymeshlab does not work ({failed['pymeshlab']}): libigl takes its place, less evenly.")
    if "video" in failed:
        slow.append(f"No video encoder ({failed['video']}): films become single frames.")
    if machine.cores < 2:
        slow.append("One core: everything takes about twice the times of the documentation.")
    if machine.instructions and not {"avx2", "asimd"} & set(machine.instructions):
        slow.append("No AVX2: splatting takes several times as long.")
    for name, value in machine.thread_limits.items():
        if value.isdigit() and int(value) < machine.cores:
            slow.append(f"{name}={value} leaves cores idle: unset it unless that is wanted.")
    return slow, broken
