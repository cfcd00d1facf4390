"""Parts of the method that a run can leave out: `gw train --without sg,reg`. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import replace

from stages.shared.errors import UsageProblem
from stages.train.config import TrainConfig

# Terms of the loss that each name switches off; sg, reg and pe are the published ablation (Gaussian Wardrobe,
# table of the ablation: without segmentation, regularisation, penetration). A part is left out everywhere:
# tracking uses labels and collisions too.
_TERMS: dict[str, tuple[str, ...]] = {
    "sg": ("label",),
    "reg": ("offset", "smooth", "opacity", "seam", "covered_skin"),
    "pe": ("penetration",),
    "bs": ("silhouette",),
    "ssim": ("ssim",),
    "lpips": ("lpips", "face"),
    "flow": ("flow",),
}
PARTS: dict[str, str] = {
    "sg": "segmentation: the label loss, and labels in tracking",
    "reg": "what keeps Gaussians tidy: offset, smoothing, seam, body opacity, covered skin",
    "pe": "penetration: the loss between layers, and collisions in tracking",
    "bs": "the body's silhouette",
    "ssim": "SSIM of the pictures",
    "lpips": "LPIPS of subject and face",
    "flow": "optical flow from render to image",
    "coarse": "small pictures first",
    "tracking": "following the garments through the take first",
    "history": "recent motion beside the pose",
    "anchors": "free offsets of anchor poses",
    "base": "free attributes per texel",
    "prior": "projection of poses unlike the training's",
}


def apply_ablation(config: TrainConfig) -> TrainConfig:
    """The configuration without the parts that its `without` names; doing it twice changes nothing.

    Raises:
        UsageProblem: a name that is not one of `PARTS`.
    """
    for name in config.without:
        if name not in PARTS:
            raise UsageProblem(
                f"There is no part {name!r} to leave out.",
                "option --without",
                "Choose of: " + ", ".join(PARTS) + ".",
            )
    off = {term: 0.0 for name in config.without for term in _TERMS.get(name, ())}
    config = replace(config, weights=replace(config.weights, **off))
    if "coarse" in config.without:
        config = replace(config, coarse_until=0.0)
    model = config.model
    if "anchors" in config.without:
        model = replace(model, anchors=0)
    if "history" in config.without:
        model = replace(model, history=0)
    if "tracking" in config.without:
        config = replace(config, track=replace(config.track, frame_step=0))
    if "sg" in config.without:
        config = replace(config, track=replace(config.track, labels=False))
    if "pe" in config.without:
        config = replace(config, track=replace(config.track, collision=0.0))
    if "prior" in config.without:
        model = replace(model, pose_prior=0)
    if "base" in config.without:
        model = replace(model, base=False)
    return replace(config, model=model)
