"""Files outside artifacts: the old one or the new one, never half."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from stages.shared.artifacts import require_room, whole_folder, write_whole
from stages.shared.artifacts.files import WRITE_BYTES, FileLayer, using_layer
from stages.shared.errors import StorageFailure


class Failing(FileLayer):
    """Fails at the n-th write, flush or rename."""

    def __init__(self, at: int, code: int) -> None:
        self.left, self.code = at, code

    def _count(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError(self.code, "injected")

    def write(self, descriptor: int, data: memoryview) -> int:
        self._count()
        return super().write(descriptor, data[: len(data) // 2 + 1])  # a short write, as a system may do

    def flush(self, descriptor: int) -> None:
        self._count()
        super().flush(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        self._count()
        super().rename(source, target)


def test_a_file_is_replaced_and_folders_are_made(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file.bin"
    write_whole(path, b"old")
    write_whole(path, [b"ne", memoryview(b"w")])
    assert path.read_bytes() == b"new"
    assert [file.name for file in path.parent.iterdir()] == ["file.bin"]


def test_large_files_are_whole(tmp_path: Path) -> None:
    data = bytes(range(256)) * (WRITE_BYTES // 128) + b"end"
    write_whole(tmp_path / "large", data)
    assert (tmp_path / "large").read_bytes() == data


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_a_failure_at_any_call_leaves_the_old_file(tmp_path: Path, code: int) -> None:
    path = tmp_path / "file"
    write_whole(path, b"old")
    failures = 0
    for at in range(30):
        with using_layer(Failing(at, code)):
            try:
                write_whole(path, b"something new")
            except StorageFailure as failure:
                failures += 1
                assert failure.exit_code == 74 and str(tmp_path) in failure.where
                assert ("bytes free" in failure.what) == (code != errno.EIO)
                assert path.read_bytes() == b"old"
                assert [file.name for file in tmp_path.iterdir()] == ["file"]
            else:
                break
    assert failures >= 4
    assert path.read_bytes() == b"something new"


def test_the_message_says_how_much_was_needed(tmp_path: Path) -> None:
    with (
        using_layer(Failing(0, errno.ENOSPC)),
        pytest.raises(StorageFailure, match=r"12345 bytes needed, [0-9]+ bytes"),
    ):
        write_whole(tmp_path / "file", bytes(12345))


def test_no_permission_is_a_storage_failure(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"in the way of a folder")
    with pytest.raises(StorageFailure):
        write_whole(tmp_path / "file" / "inner", b"data")


def test_a_folder_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "frames"
    with whole_folder(target) as folder:
        (folder / "0.png").write_bytes(b"0")
        assert not target.exists()
    with pytest.raises(RuntimeError), whole_folder(target) as folder:
        (folder / "1.png").write_bytes(b"1")
        raise RuntimeError
    assert [file.name for file in target.iterdir()] == ["0.png"]
    with whole_folder(target) as folder:
        (folder / "2.png").write_bytes(b"2")
    assert [file.name for file in target.iterdir()] == ["2.png"]
    assert [file.name for file in tmp_path.iterdir()] == ["frames"]


def test_too_little_room_is_refused_before_starting(tmp_path: Path) -> None:
    require_room(tmp_path / "not" / "there", 1)
    with pytest.raises(StorageFailure, match="bytes needed"):
        require_room(tmp_path, 1 << 60)
