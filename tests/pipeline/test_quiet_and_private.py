"""No socket in any command but `view`, no write outside the target, no artifact that says who made it."""

from __future__ import annotations

import getpass
import json
import platform
import re
import tempfile
from pathlib import Path
from typing import Any

import pytest

from tests.pipeline.chain import REPOSITORY, TINY, WATCHED, gw

pytestmark = pytest.mark.timeout(900)  # the first of these makes the chain


@pytest.fixture(scope="module")
def used(made: Path) -> Path:
    """The chain, with bundles and a film of them."""
    for layer in ("body", "lower"):
        gw("export-garment", "subject", "--layer", layer, "-o", f"private/{layer}.gwg", folder=made)
    bundles = ("private/body.gwg", "private/lower.gwg")
    gw("tryon", *bundles, "--poses", "people/motions/held_out.npz", *TINY, "-o", "private/worn", folder=made)
    gw("status", "subject", folder=made)
    gw("verify", "subject", folder=made)
    return made


@pytest.fixture(scope="module")
def watched(used: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (used / WATCHED).read_text().splitlines()]


def test_no_command_opens_a_socket(watched: list[dict[str, Any]]) -> None:
    assert {line["command"][0] for line in watched} >= {"synth", "train", "export-garment", "tryon", "status"}
    for line in watched:
        # urllib3, which open3d loads, asks the system for IPv6 by a socket on the loopback; it never listens.
        reached = [event for event in line["sockets"] if not event.endswith("('::1', 0))")]
        assert reached == [], line["command"]


def test_no_process_but_our_own_children(watched: list[dict[str, Any]]) -> None:
    """pymeshlab runs in a child; libraries may ask the system for its name when they load."""
    allowed = re.compile(
        r"stages\.shared\.meshes\.remesh|quarantine\.py|'(lscpu|uname|ldconfig|gcc|ld)|/sbin/ldconfig"
    )
    for line in watched:
        strange = [process for process in line["processes"] if not allowed.search(process)]
        assert strange == [], line["command"]


def test_nothing_is_written_outside(watched: list[dict[str, Any]], used: Path) -> None:
    """The folder it was told to write to, temporary files, and caches of compiled code."""
    allowed = (str(used), tempfile.gettempdir(), "/dev/", "/proc/self/", "/sys/", str(REPOSITORY / "stages"))
    for line in watched:
        outside = [
            path
            for path in line["written"]
            if not path.startswith(allowed) and "__pycache__" not in path and "/numba" not in path
        ]
        assert outside == [], line["command"]


def _secrets(folder: Path) -> list[bytes]:
    """Texts that no artifact may hold: names of this machine and places on it."""
    texts = {platform.node(), str(folder), str(Path.home()), str(REPOSITORY), tempfile.gettempdir() + "/"}
    if len(getpass.getuser()) > 4:
        texts.add(getpass.getuser())
    return [text.encode() for text in texts if len(text) > 4]


def _mentions(path: Path, secrets: list[bytes]) -> list[str]:
    data = path.read_bytes()
    return [f"{path}: {secret.decode()}" for secret in secrets if secret in data]


def test_no_artifact_names_user_host_or_place(used: Path) -> None:
    secrets = _secrets(used)
    assert len(secrets) >= 3
    files = [path for path in used.rglob("*") if path.is_file() and not path.name.startswith(".")]
    files = [path for path in files if path.name != WATCHED]
    assert len(files) > 100 and any(path.suffix == ".gwg" for path in files)
    assert [mention for path in files for mention in _mentions(path, secrets)] == []


def test_the_search_would_find_one(tmp_path: Path) -> None:
    (tmp_path / "note.json").write_text(f'{{"capture": "{tmp_path}/people"}}')
    assert _mentions(tmp_path / "note.json", _secrets(tmp_path))


def test_memory_of_the_tiny_chain(used: Path) -> None:
    """Run records say what every stage took: far from the 1.5 GiB that a demo may take."""
    records = [json.loads(path.read_text()) for path in used.glob("subject/*/*/run.json")]
    assert len(records) >= 5
    for record in records:
        assert 50 << 20 < record["peak_bytes"] < 1.5 * 2**30
        assert 0 < record["seconds"] <= record["stage_seconds"]
