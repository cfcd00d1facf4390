"""Frame, unit, axes and colours of an exported file, as JSON next to it, since viewers disagree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stages.shared.artifacts import write_whole
from stages.shared.artifacts.canonical import readable_json

NOTES_NAME = "export_notes.json"

_AXES = {
    "y": "right-handed, +y up, the person faces +z, its left hand is on +x",
    "-y": "right-handed, +y down as in 3D Gaussian splatting, the person faces -z, its left hand is on +x",
}
_COMMON: dict[str, Any] = {
    "unit": "metre",
    "axes": _AXES["y"],
    "color_space": "sRGB, display-referred (IEC 61966-2-1); blended as it is, without linearisation",
    "harmonics_degree": 0,
    "blur_px2": 0.3,
    "antialiased": False,
    "blending": "front to back by depth along the optical axis; alpha = min(0.999, opacity * gaussian), "
    "left out below 1/255",
    "penetration_pass": "not part of the file: it changes pixels, not Gaussians",
}
_FORMATS: dict[str, dict[str, Any]] = {
    "ply": {
        "layout": "3D Gaussian splatting: f_dc = (colour - 0.5) / 0.28209, opacity logit, log scale, wxyz",
        "loss": "none beyond float32",
    },
    "spz": {
        "layout": "SPZ version 3, axes right up back (RUB): no turning needed",
        "loss": "opacity 1/255, colour 1/136, scales up to 3.2 %, rotations about 0.1 degrees",
    },
    "glb": {
        "layout": "glTF 2.0, KHR_gaussian_splatting (release candidate): linear scale and opacity, xyzw; "
        "one node per layer; COLOR_0 is linear, for viewers without the extension",
        "loss": "none beyond float32",
    },
    "mesh": {
        "layout": "glTF 2.0 skin of 55 joints (SMPL-X names), 8 weights per vertex; vertex colours linear",
        "loss": "weights beyond the 8 largest are left out",
    },
}


def axes_text(up: str) -> str:
    """What the axes of a file mean whose `up` is "y" or "-y"."""
    return _AXES[up]


def write_notes(path: Path, kind: str, frame: str, **more: Any) -> None:
    """Write notes for files of one kind ("ply", "spz", "glb" or "mesh").

    Arguments:
        frame: "world" or "canonical…": where the positions are. more: layers, frames per second and so on.
    """
    common = _COMMON if kind != "mesh" else {name: _COMMON[name] for name in ("unit", "axes")}
    write_whole(path, readable_json({"format": kind, "frame": frame, **common, **_FORMATS[kind], **more}))
