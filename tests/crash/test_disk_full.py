"""A disk that is full, or fails, at any call: exit code 74, and what was whole stays whole."""

from __future__ import annotations

import errno
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from stages.shared.artifacts import Workspace
from stages.shared.artifacts.files import using_layer
from stages.shared.artifacts.verify import verify
from stages.shared.errors import StorageFailure
from tests.crash.fake_stage import Config, CountingLayer, FailingLayer, run

Undisturbed = tuple[tuple[str, str], list[str]]


class FinishNoticing(CountingLayer):
    """Notes at which call the first artifact gets its name."""

    finished = 0

    def rename(self, source: Path, target: Path) -> None:
        if target.parent.name == "prepare" and not self.finished and target.suffix != ".json":
            self.finished = len(self.calls)
        super().rename(source, target)


def whole_content(subject: Path) -> dict[str, bytes]:
    files = (path for path in subject.glob("*/**/*") if path.is_file())
    return {path.relative_to(subject).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize(("code", "stride"), [(errno.ENOSPC, 1), (errno.EIO, 5)], ids=["full", "failing"])
def test_every_call_in_turn(
    undisturbed: Undisturbed, crash_capture: Path, tmp_path: Path, code: int, stride: int
) -> None:
    """On a subject that has finished artifacts of another configuration, which must not change."""
    expected, _ = undisturbed
    finished = tmp_path / "finished"
    run(finished, crash_capture, Config(seed=2))
    before = whole_content(finished)
    failed: list[str] = []
    for at in range(0, 1000, stride):
        subject = shutil.copytree(finished, tmp_path / str(at))
        with using_layer(FailingLayer(at, code)) as layer:
            try:
                found = run(subject, crash_capture)
            except StorageFailure as failure:
                assert isinstance(layer, FailingLayer)
                failed.append(layer.calls[at])
                assert failure.exit_code == 74 and str(subject) in failure.where
                if code == errno.ENOSPC:
                    assert re.search(r"The disk is full: .*[0-9]+ bytes free", failure.what)
                    assert layer.calls[at] != "write" or re.search(r"[0-9]+ bytes needed", failure.what)
            else:
                assert found[:2] == expected
                break
        assert verify(Workspace(subject)).damaged == []
        after = whole_content(subject)
        assert {path: after[path] for path in before if not path.endswith("current.json")} == {
            path: data for path, data in before.items() if not path.endswith("current.json")
        }
        assert list(subject.glob(".*.tmp-*")) == []
        if at % 20 == 0:
            assert run(subject, crash_capture)[:2] == expected
        shutil.rmtree(subject)
    assert len(failed) > 100 // stride
    kinds = {"create", "append", "write", "flush", "flush_folder", "rename", "make_folder"}
    assert set(failed) == kinds if stride == 1 else set(failed) <= kinds


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO], ids=["full", "failing"])
def test_a_first_run_leaves_no_final_name(crash_capture: Path, tmp_path: Path, code: int) -> None:
    """Up to the rename that finishes it, no failure leaves an artifact or a pointer to one."""
    with using_layer(FinishNoticing()) as layer:
        run(tmp_path / "other", crash_capture)
    assert isinstance(layer, FinishNoticing) and layer.finished > 20
    for at in range(layer.finished + 1):
        subject = tmp_path / str(at)
        with using_layer(FailingLayer(at, code)), pytest.raises(StorageFailure):
            run(subject, crash_capture)
        assert list(subject.glob("*/*")) == []


FILL = """
import sys
from pathlib import Path
from tests.crash.fake_stage import Config, run
from stages.shared.errors import GwError
try:
    run(Path(sys.argv[1]) / "subject", Path(sys.argv[2]), Config(size=1_000_000))
except GwError as error:
    print(error.what)
    print(sorted(path.name for path in Path(sys.argv[1], "subject").glob("*/*")))
    sys.exit(error.exit_code)
"""


def test_a_disk_that_is_really_full(crash_capture: Path, tmp_path: Path) -> None:
    """A file system of 4 MiB in a name space of its own, and 12 MB to write."""
    script = f'mount -t tmpfs -o size=4m none "$1" && exec "{sys.executable}" -c "$2" "$1" "$3"'
    command = [
        "unshare",
        "--mount",
        "--map-root-user",
        "sh",
        "-c",
        script,
        "sh",
        str(tmp_path),
        FILL,
        str(crash_capture),
    ]
    try:
        probe = subprocess.run(
            [*command[:3], "sh", "-c", f'mount -t tmpfs none "{tmp_path}"'], capture_output=True
        )
    except FileNotFoundError:
        pytest.skip("this system has no unshare")
    if probe.returncode != 0:
        pytest.skip("this user may not mount a small file system")
    done = subprocess.run(
        command, cwd=Path(__file__).resolve().parents[2], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 74, done.stderr
    what, names = done.stdout.splitlines()
    assert re.fullmatch(r"The disk is full: 1200\d{4} bytes needed, \d+ bytes free\.", what)
    assert names == "[]"
