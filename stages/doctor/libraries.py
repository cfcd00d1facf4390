"""Which libraries are there, and whether the difficult ones survive being used: each in a child process."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata

CORE = (
    "torch", "numpy", "scipy", "numba", "trimesh", "open3d", "libigl", "pymeshlab",
    "opencv-contrib-python-headless", "safetensors", "roma", "av", "typer", "rich",
)  # fmt: skip
OPTIONAL = (
    "gsplat",
    "anny",
    "snakemake",
    "tensorboardX",
    "matplotlib",
    "atheris",
    "ai-edge-litert",
)  # the extras of pyproject.toml
_SECONDS = 120.0

_PROGRAMS = {
    "torch": "import torch; assert float(torch.ones(8).sum()) == 8",
    "open3d": (
        "import numpy as np\n"
        "from stages.shared.meshes.mesh import Mesh\n"
        "from stages.shared.meshes.raycast import RayScene\n"
        "mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]))\n"
        "scene = RayScene(mesh.vertices, mesh.faces)\n"
        "assert scene.occluded(np.zeros(3), np.ones((1, 3)) * 3.0, 0.01).tolist() == [True]\n"
    ),
    "pymeshlab": (
        "import trimesh\n"
        "from stages.shared.meshes.mesh import Mesh\n"
        "from stages.shared.meshes.remesh import simplify\n"
        "ball = trimesh.creation.icosphere(2)\n"
        "assert simplify(Mesh(ball.vertices, ball.faces), 100)[1] == 'pymeshlab'\n"
    ),
    "video": (
        "import av\n"
        "assert any(name in av.codecs_available for name in ('libx264', 'h264', 'libopenh264', 'mpeg4'))\n"
    ),
    "cuda": (
        "from stages.shared.splat.cuda import why_not\n"
        "reason = why_not()\n"
        "import sys\n"
        "sys.exit(reason if reason else 0)\n"
    ),
}


@dataclass(frozen=True)
class Check:
    """One thing that was tried in a child process: whether it worked, and if not, what it said."""

    name: str
    works: bool
    said: str = ""


def versions(names: tuple[str, ...]) -> dict[str, str | None]:
    """Installed versions by name; None where it is not installed."""
    found: dict[str, str | None] = {}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def try_all(seconds: float = _SECONDS) -> list[Check]:
    """Use every difficult library once."""
    return [try_program(name, program, seconds) for name, program in _PROGRAMS.items()]


def try_program(name: str, program: str, seconds: float = _SECONDS) -> Check:
    """Run a few lines of Python in a process of their own: it may crash, hang, or be killed."""
    command = [sys.executable, "-c", program]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return Check(name, False, f"no answer within {seconds:.0f} s")
    except OSError as error:
        return Check(name, False, f"no process could be started: {error.strerror}")
    if done.returncode == 0:
        return Check(name, True)
    if done.returncode < 0:
        return Check(name, False, f"ended by signal {-done.returncode}")
    last = done.stderr.strip().splitlines()
    said = last[-1] if last else f"exit code {done.returncode}"
    return Check(name, False, re.sub(r"^stages\.[\w.]+: ", "", said))  # our own errors speak for themselves
