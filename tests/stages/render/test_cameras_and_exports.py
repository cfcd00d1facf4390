"""Camera paths out of files, splat files beside the pictures, films of every kind."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from gw_cli.app import app
from stages.render import stage
from stages.shared.body import embedded_body
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.export.splats import read_splats
from stages.shared.outfit.retarget import fix_foot_height
from stages.shared.render_sequence.camera_path import path_cameras
from stages.shared.render_sequence.config import RenderConfig
from tests.shared.outfit.wardrobe import cameras, motion, outfit

SMALL = RenderConfig(width=48, height=64)


def path_file(folder: Path, **content: object) -> Path:
    path = folder / "path.json"
    path.write_text(json.dumps({"format": "gw-camera-path", "version": 1, **content}))
    return path


def key(frame: float, position: list[float], **more: object) -> dict[str, object]:
    return {"frame": frame, "position": position, "target": [0, 0.1, 0], **more}


def test_keys_are_met_and_glided_between(tmp_path: Path) -> None:
    keys = [key(0, [0, 0, 3], field_of_view=40), key(4, [3, 0, 0], field_of_view=20), key(6, [3, 0, 3])]
    found = path_cameras(path_file(tmp_path, keys=keys), 9, (80, 60))
    for frame, place in ((0, [0, 0, 3]), (4, [3, 0, 0]), (6, [3, 0, 3]), (8, [3, 0, 3])):
        np.testing.assert_allclose(found[frame].centre, place, atol=1e-9)
    pixels, depth = found[3].project([0, 0.1, 0])
    np.testing.assert_allclose(pixels, [40, 30], atol=1e-6)  # the target is in the middle
    assert depth > 0 and found[4].camera_from_world[1, 1] < 0  # y of the image points down
    focal = [camera.intrinsics[1, 1] for camera in found]
    assert focal[0] == pytest.approx(30 / np.tan(np.deg2rad(20)))
    assert focal[4] == focal[6] == pytest.approx(30 / np.tan(np.deg2rad(10)))
    steps = np.diff([camera.centre[0] for camera in found[:5]])
    assert (steps > 0).all()  # no overshoot
    turned = path_cameras(path_file(tmp_path, keys=[key(0, [0, 0, 3], up=[1, 0, 0])]), 2, (80, 60))
    assert turned[1].camera_from_world[1, 0] == pytest.approx(-1)


def test_matrices_are_taken_as_they_are(tmp_path: Path) -> None:
    listed = [
        {
            "width": camera.width,
            "height": camera.height,
            "intrinsics": camera.intrinsics.tolist(),
            "camera_from_world": camera.camera_from_world.tolist(),
        }
        for camera in cameras()[:2]
    ]
    found = path_cameras(path_file(tmp_path, cameras=listed), 3, (10, 10))
    for index, camera in ((0, cameras()[0]), (1, cameras()[1]), (2, cameras()[1])):
        assert np.array_equal(found[index].camera_from_world, camera.camera_from_world)
        assert found[index].width == camera.width


@pytest.mark.parametrize(
    "content",
    [
        {}, {"keys": []}, {"keys": [key(0, [0, 0, 3])], "cameras": []}, {"keys": [key(0, [0, 0])]},
        {"keys": [key(2, [0, 0, 3]), key(1, [0, 0, 4])]}, {"keys": [key(0, [0, 5, 0])]},
        {"keys": [key(0, [0, 0.1, 0])]}, {"keys": [key(0, [0, 0, 3], field_of_view=180)]},
        {"keys": [key(0, [0, 0, 3], roll=3)]}, {"keys": [3]}, {"cameras": [{"width": 4}]}, {"version": 2},
        {"keys": [{"frame": "a", "position": [0, 0, 1], "target": [0, 0, 0]}]},
    ],
)  # fmt: skip
def test_strange_paths_are_refused(tmp_path: Path, content: dict[str, object]) -> None:
    with pytest.raises(BadData, match=r"path\.json"):
        path_cameras(path_file(tmp_path, **content), 3, (10, 10))


def test_broken_and_missing_paths(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"format": NaN}')
    with pytest.raises(BadData):
        path_cameras(tmp_path / "a.json", 3, (10, 10))
    with pytest.raises(MissingInput):
        path_cameras(tmp_path / "b.json", 3, (10, 10))


def test_a_path_in_a_render(wardrobe: Path, tmp_path: Path) -> None:
    path = path_file(tmp_path, keys=[key(0, [0, 0.1, 3]), key(4, [0, 0.1, 1])])
    config = RenderConfig(width=48, height=64, camera=str(path), penetration=False)
    stage.run([wardrobe / "body.gwg"], wardrobe / "motion.npz", None, tmp_path / "out", config)
    seen = [
        (cv2.imread(str(tmp_path / f"out/frames/00000{row}.png"), cv2.IMREAD_UNCHANGED)[..., 3] > 127).sum()
        for row in (0, 4)
    ]
    assert seen[1] > 4 * seen[0]  # three times nearer


def test_exports_are_the_posed_gaussians(wardrobe: Path, tmp_path: Path) -> None:
    config = RenderConfig(width=48, height=64, frames="1:4:2", exports=("ply", "spz", "glb"), pictures=False)
    bundles = [wardrobe / "body.gwg", wardrobe / "upper.gwg"]
    result = stage.run(bundles, wardrobe / "motion.npz", None, tmp_path / "out", config)
    assert result.summary["pictures"] == 0 and result.summary["video"] is None
    assert not (tmp_path / "out/frames").exists() and not (tmp_path / "out/records").exists()
    for kind, loss in (("ply", 5e-6), ("glb", 5e-6), ("spz", 1e-5)):
        folder = tmp_path / "out" / kind
        names = sorted(path.name for path in folder.iterdir())
        assert names == ["export_notes.json", f"frame000001.{kind}", f"frame000003.{kind}"]
        notes = json.loads((folder / "export_notes.json").read_bytes())
        assert notes["frame"].startswith("world") and notes["layers"] == ["body", "upper"]
        wanted = outfit("body", "upper").composite(motion(), 3).means.numpy()
        found = read_splats(folder / f"frame000003.{kind}").means
        assert ("+y down" in notes["axes"]) == (kind == "ply")
        turned = np.array([1, -1, -1] if kind == "ply" else [1, 1, 1])
        np.testing.assert_allclose(found * turned, wanted, atol=loss)


@pytest.mark.parametrize(
    ("up", "kind", "down"), [("auto", "ply", True), ("y", "ply", False), ("-y", "spz", True)]
)
def test_exports_stand_upright_by_the_convention_that_is_asked_for(
    up: str, kind: str, down: bool, wardrobe: Path, tmp_path: Path
) -> None:
    """Checked by another reader: the body's head is its end with smaller y where y points down."""
    config = RenderConfig(frames="0:1", exports=(kind,), pictures=False, up=up)
    stage.run([wardrobe / "body.gwg"], wardrobe / "motion.npz", None, tmp_path / "out", config)
    path = tmp_path / f"out/{kind}/frame000000.{kind}"
    if kind == "ply":
        vertices = trimesh.load(path, process=False).vertices
    else:  # the fixed-point positions by hand
        data = gzip.decompress(path.read_bytes())
        count, bits = int.from_bytes(data[8:12], "little"), data[13]
        triples = np.frombuffer(data, np.uint8, 9 * count, 16).reshape(count, 3, 3).astype(np.int64)
        whole = triples @ [1, 1 << 8, 1 << 16]
        vertices = np.where(whole >= 1 << 23, whole - (1 << 24), whole) / (1 << bits)
    composite = outfit("body").composite(motion(), 0)
    true, sign = composite.means.numpy(), -1 if down else 1
    np.testing.assert_allclose(vertices, true * [1, sign, sign], atol=1e-3)
    cloud = read_splats(path)
    axes = Rotation.from_quat(cloud.quats[:, [1, 2, 3, 0]]).as_matrix() * cloud.scales[:, None]
    turn = np.diag([1.0, sign, sign])
    expected = turn @ composite.covariances.numpy() @ turn
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), expected, atol=2e-6 if kind == "ply" else 2e-5)


def test_gltf_always_has_y_up(wardrobe: Path, tmp_path: Path) -> None:
    for up, kinds in (("-y", ("glb",)), ("z", ("ply",))):
        config = RenderConfig(frames="0:1", exports=kinds, pictures=False, up=up)
        with pytest.raises(UsageProblem, match="up"):
            stage.run([wardrobe / "body.gwg"], wardrobe / "motion.npz", None, tmp_path / "out", config)


def test_the_canonical_pose(wardrobe: Path, tmp_path: Path) -> None:
    """With the shape removed these are the maps' own positions."""
    config = RenderConfig(width=48, height=64, exports=("ply",), betas="0")
    result = stage.run([wardrobe / "body.gwg"], Path("canonical"), None, tmp_path / "out", config)
    assert result.summary["pictures"] == 1 and result.summary["video"] is None
    found = read_splats(tmp_path / "out/ply/frame000000.ply").means
    np.testing.assert_allclose(
        found * [1, -1, -1], outfit("body").layers[0].maps.positions.numpy(), atol=1e-5
    )


def test_films_of_every_kind(wardrobe: Path, tmp_path: Path) -> None:
    films = {}
    for name, video, background in (
        ("a", "vp9", "black"),
        ("b", "none", "black"),
        ("c", "auto", "transparent"),
    ):
        config = RenderConfig(width=48, height=64, frames="0:3", video=video, background=background)
        bundles = [wardrobe / "body.gwg"]
        result = stage.run(bundles, wardrobe / "motion.npz", None, tmp_path / name, config)
        films[name] = result.summary["video"]
    assert films == {"a": "film.webm", "b": None, "c": "film.webm"}
    with av.open(str(tmp_path / "c/film.webm")) as film:
        assert film.streams.video[0].metadata.get("alpha_mode") == "1"
    with av.open(str(tmp_path / "a/film.webm")) as film:
        assert next(film.decode(video=0)).to_ndarray(format="rgb24")[0, 0].max() < 8


def test_film_speed_is_the_motions_or_the_one_asked_for(wardrobe: Path, tmp_path: Path) -> None:
    for fps, expected, frames in ((0.0, 30, 5), (15.0, 15, 3)):
        config = RenderConfig(width=48, height=64, fps=fps)
        out = tmp_path / str(expected)
        result = stage.run([wardrobe / "body.gwg"], wardrobe / "motion.npz", None, out, config)
        with av.open(str(out / result.summary["video"])) as film:
            assert film.streams.video[0].average_rate == expected
        assert result.summary["pictures"] == frames


def test_what_cannot_be_asked_for(wardrobe: Path, tmp_path: Path) -> None:
    bundles, poses = [wardrobe / "body.gwg"], wardrobe / "motion.npz"
    for config in (
        RenderConfig(exports=("obj",)),
        RenderConfig(video="h264", background="transparent"),
        RenderConfig(video="gif"),
        RenderConfig(background="blue"),
    ):
        with pytest.raises(UsageProblem):
            stage.run(bundles, poses, None, tmp_path / "out", config)
    assert list(tmp_path.iterdir()) == []


def test_the_command_tells_how_to_merge(wardrobe: Path, tmp_path: Path) -> None:
    words = [
        "render",
        str(wardrobe / "body.gwg"),
        "--poses",
        str(wardrobe / "motion.npz"),
        "--preset",
        "tiny",
    ]
    words += ["-o", str(tmp_path / "out"), "--shard", "1/2", "--export", "spz"]
    dry = CliRunner().invoke(app, [*words, "--dry-run", "--json"])
    plan = json.loads(dry.stdout.splitlines()[-1])["result"]
    assert plan["dry_run"] and any(name.endswith("/spz") for name in plan["outputs"])
    assert list(tmp_path.iterdir()) == []
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    assert "when all parts are done" in done.stderr and not (tmp_path / "out").exists()
    text = CliRunner().invoke(app, ["render", "--help"]).stdout
    assert "gw-camera-path" in text and "--shard" in text and "canonical" in text


def test_a_taller_wearer_keeps_the_floor(wardrobe: Path, tmp_path: Path) -> None:
    """Shape 0 of the body model lengthens legs: the hips rise with it, and with --no-ground they do not."""
    heights = {}
    for ground in (True, False):
        config = RenderConfig(
            exports=("ply",), up="y", pictures=False, betas="4", ground=ground, frames="2:3"
        )
        out = tmp_path / str(ground)
        stage.run([wardrobe / "body.gwg"], wardrobe / "motion.npz", None, out, config)
        heights[ground] = read_splats(out / "ply/frame000002.ply").means[:, 1].mean()
    from_embedded = embedded_body()
    wearer = np.array([4, *[0] * 9], np.float32)
    moved = fix_foot_height(motion(), from_embedded, wearer).translation[2, 1] - motion().translation[2, 1]
    assert abs(moved) > 0.01
    assert heights[True] - heights[False] == pytest.approx(moved, abs=1e-4)
