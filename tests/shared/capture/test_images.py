from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.shared.capture.images import read_image, read_mask
from stages.shared.capture.labels import label_picture, read_labels
from stages.shared.errors import BadData, GwError
from stages.shared.layers import LABEL_COLORS, LABELS

PIL = pytest.importorskip("PIL.Image", reason="palette images are written with Pillow")
IDS = np.array([[0, 1, 2, 3], [4, 5, 255, 3]], np.uint8)


def palette_png(path: Path, indices: np.ndarray, palette: list[int]) -> Path:
    image = PIL.fromarray(indices)
    image.putpalette(palette + [255] * (768 - len(palette)))
    image.save(path)
    return path


def own_palette() -> list[int]:
    palette = [255] * 768
    for label, color in LABEL_COLORS.items():
        palette[3 * label : 3 * label + 3] = color
    return palette


def test_labels_from_ids_palette_and_colors_agree(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "ids.png"), IDS)
    palette_png(tmp_path / "palette.png", IDS, own_palette())
    cv2.imwrite(str(tmp_path / "colors.png"), label_picture(IDS)[..., ::-1])
    for name in ("ids", "palette", "colors"):
        np.testing.assert_array_equal(read_labels(tmp_path / f"{name}.png"), IDS, err_msg=name)


def test_palette_is_read_as_pillow_reads_it(subject_a: Path) -> None:
    path = subject_a / "Sequence1/1x/labels/Cam003/label-f000017.png"
    np.testing.assert_array_equal(read_labels(path), np.asarray(PIL.open(path)))


def test_a_sorted_palette_is_read_by_its_colors(tmp_path: Path) -> None:
    """Image editors renumber palettes; the colours keep their meaning."""
    order = [5, 255, 0, 3, 2, 4, 1]  # index -> label
    indices = np.array([[order.index(label) for label in row] for row in IDS], np.uint8)
    path = palette_png(
        tmp_path / "p.png", indices, [value for label in order for value in LABEL_COLORS[label]]
    )
    np.testing.assert_array_equal(read_labels(path), IDS)


def test_a_palette_of_other_colors_is_read_by_its_indices(tmp_path: Path) -> None:
    path = palette_png(tmp_path / "p.png", IDS, [value for i in range(256) for value in (i, i // 2, 9)])
    np.testing.assert_array_equal(read_labels(path), IDS)


def test_unknown_ids_are_named_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "label-f000003.png"
    cv2.imwrite(str(path), np.array([[0, 6, 9]], np.uint8))
    with pytest.raises(BadData, match="6, 9") as caught:
        read_labels(path)
    assert caught.value.where == str(path) and caught.value.exit_code == 65


def test_unknown_colors_are_named(tmp_path: Path) -> None:
    path = tmp_path / "l.png"
    cv2.imwrite(str(path), np.array([[[3, 2, 1], [128, 128, 128]]], np.uint8))
    with pytest.raises(BadData, match=r"\(1, 2, 3\)"):
        read_labels(path)


def test_masks_take_the_first_channel(tmp_path: Path) -> None:
    soft = np.array([[0, 100, 255]], np.uint8)
    write = {"grey": soft, "color": np.stack([soft * 0, soft * 0, soft], axis=-1)}  # OpenCV writes B G R
    for name, image in write.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
        np.testing.assert_array_equal(read_mask(tmp_path / f"{name}.png"), soft)


def test_masks_of_zeros_and_ones_are_stretched(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "m.png"), np.array([[0, 1, 1]], np.uint8))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), [[0, 255, 255]])


def test_sixteen_bits_become_eight(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "m.png"), np.array([[0, 32768, 65535]], np.uint16))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), [[0, 128, 255]])


def test_images_are_rgb(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "i.png"), np.array([[[1, 2, 3]]], np.uint8))
    np.testing.assert_array_equal(read_image(tmp_path / "i.png"), [[[3, 2, 1]]])


@pytest.mark.parametrize("kind", [".png", ".jpg"])
def test_every_cut_is_noticed(tmp_path: Path, kind: str) -> None:
    """A decoder may fill up what is missing with grey; that must not pass for a picture."""
    image = np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    data = cv2.imencode(kind, image)[1].tobytes()
    path = tmp_path / f"cut{kind}"
    for length in [0, 1, 7, 20, *range(40, len(data) - 2, len(data) // 40), len(data) - 3]:
        path.write_bytes(data[:length])
        with pytest.raises(BadData) as caught:
            read_image(path)
        assert str(path) == caught.value.where
    path.write_bytes(data)
    assert read_image(path).shape == (40, 40, 3)


def test_one_flipped_bit_in_a_png_is_noticed(tmp_path: Path) -> None:
    data = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (20, 20), np.uint8))[1].tobytes()
    for position in range(8, len(data), 7):
        broken = bytearray(data)
        broken[position] ^= 4
        (tmp_path / "m.png").write_bytes(broken)
        with pytest.raises(BadData):
            read_mask(tmp_path / "m.png")


def test_a_huge_picture_is_refused_by_its_header(tmp_path: Path) -> None:
    """A few hundred bytes that unpack to gigabytes."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    path = tmp_path / "bomb.png"
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"0"))
        + chunk(b"IEND", b"")
    )
    with pytest.raises(BadData, match="64 million"):
        read_image(path)


def test_other_formats_and_absent_files(tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(b"GIF89a....")
    with pytest.raises(BadData, match="neither a PNG nor a JPEG"):
        read_image(tmp_path / "x.png")
    with pytest.raises(GwError) as caught:
        read_image(tmp_path / "none.png")
    assert caught.value.exit_code == 66


def test_small_palettes_are_refused_not_guessed(tmp_path: Path) -> None:
    image = PIL.fromarray(np.array([[0, 1], [2, 3]], np.uint8))
    image.putpalette([0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3])
    stream = io.BytesIO()
    image.save(stream, "PNG", bits=2)
    (tmp_path / "p.png").write_bytes(stream.getvalue())
    with pytest.raises(BadData, match="2 bits"):
        read_labels(tmp_path / "p.png")


def test_label_colors_are_those_of_4d_dress() -> None:
    assert set(LABEL_COLORS) == set(LABELS)
    assert LABEL_COLORS[3] == (180, 50, 50) and LABEL_COLORS[1] == (255, 128, 0)
