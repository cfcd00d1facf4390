"""Configuration of `gw train`, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from stages.shared.avatar.config import PAPER_MODEL, ModelConfig
from stages.shared.errors import UsageProblem
from stages.shared.option import option

ALL_TAKES = "all"
DEFAULT_METHOD = "gaussian-wardrobe"


@dataclass(frozen=True)
class LossWeights:
    """Weight of every term; 0 switches a term off.

    `l1`, `ssim`, `label`, `silhouette` compare pictures; `flow` (m) pulls Gaussians along the optical flow
    from render to image, in the first part of a run (`flow_until`); `penetration` (hinge, m²), `offset` (m²),
    `smooth` (mm²), `seam` (mm²), `opacity` and `covered_skin` act on the Gaussians. `lpips` (crop of the
    subject) and `face` (LPIPS of the face) are in force only with a file of perceptual weights. The defaults
    are the published ones.
    """

    l1: float = 1.0
    ssim: float = 0.05
    label: float = 0.5
    silhouette: float = 0.05
    lpips: float = 0.1
    face: float = 0.1
    penetration: float = 0.5
    offset: float = 0.005
    smooth: float = 0.005
    opacity: float = 0.01
    seam: float = 0.0
    flow: float = 0.0
    covered_skin: float = 0.0


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes: of the networks, the anchors (m), the attributes per texel (their own units)."""

    network: float = 2e-3
    anchors: float = 1e-3
    offset: float = 1e-4
    quaternion: float = 2e-3
    opacity: float = 2e-2
    scale: float = 5e-3
    color: float = 1e-2


@dataclass(frozen=True)
class TrackConfig:
    """How garments are followed through the take before training (`stages/train/tracking`).

    Attributes:
        frame_step: follow every N-th frame, each with its own key pose; 0 switches tracking off.
        cell: texels per cell of the maps that are solved for; anchors may be finer.
        warm_up: steps that first learn the template's own frame. rounds: Gauss-Newton steps per frame.
        bending, stretch, inertia: weights of smoothness (second and first differences) and of staying where
            the last frame was, against one trusted pixel of one texel. collision: weight of keeping cloth
            outside the body it would otherwise be followed into; 0 lets it.
        labels: label images help: each label has grey levels of its own, and cloth is followed into its own
            label only.
        scale: size of the pictures that warm-up and tracking see, 1 is the capture's; 0 for the size at which
            a texel covers two to three pixels (`resolve.scale_by_texel`).
    """

    frame_step: int = option(
        0,
        "Follow the garments through frames at this step before training, by optical flow from render to "
        "image; 0 to go without.",
        flag="--track-step", min=0,
    )  # fmt: skip
    cell: int = 4
    warm_up: int = 60
    rounds: int = 3
    bending: float = 30.0
    stretch: float = 0.5
    inertia: float = 0.3
    collision: float = 0.0
    labels: bool = field(default=True, metadata={"omit_default": True})
    scale: float = option(
        0.0,
        "Size of the pictures that warm-up and tracking see, 1 is full size; 0: so that a texel covers two "
        "to three pixels.",
        flag="--track-scale", min=0, max=1, omit_default=True,
    )  # fmt: skip


@dataclass(frozen=True)
class TrainConfig:
    """Configuration of a training run.

    Attributes:
        seed: of weights, order of frames and cameras, backgrounds.
        steps: optimiser steps. minutes: stop earlier when this time is up (the schedules follow the clock
            then); 0 for no limit.
        frame_step: step between the frames that are learned from; 0 for a step from the length of the take
            (`resolve.frame_step_by_time`). views_per_step: cameras splatted per network pass.
        image_scale: size of the pictures learned from, 1 is the capture's. coarse_scale, coarse_until:
            smaller pictures up to this share of the run. patch: px, side of the window of each picture that
            a step sees (`stages/train/random_crop.py`); 0 for whole pictures.
        exposure: "auto" takes out of the pictures what makes one camera's colours differ from the others'.
        flow_until: share of the run in which the flow term is on, where garments are not tracked.
        stage_two: share of the run after which penetration, smoothing and the face's LPIPS are on.
        rate_end: learning rates end (cosine) at this share of their start.
        clip: ceiling of the global gradient norm; 0 for none.
        label_kind: "l1" or "l2". penetration_margin: ε, m.
        penetration_every: a step checks every N-th Gaussian for penetration, the next step other ones.
        perceptual_side: px, side of the square crops that LPIPS sees. perceptual_digest: SHA-256 of the file
            of perceptual weights, empty for none; the stage fills it in.
        weights, rates, track, model: see there.
        method: what is learned: "gaussian-wardrobe" (a layer per garment), or a baseline
            (`stages/train/methods`). without: parts left out (`stages/train/config.py`).
        takes: training takes in addition to that of the template; "all" for every one.
        from_layers: layers that start from another subject (`stages/train/warm_start.py`); all that both have
            where it is empty and such a subject is given.
        recompute: networks' activations are computed again in the backward pass instead of kept; not part of
            what the result is named by, which is the same.
        device: auto, cpu or cuda; not part of what the result is named by.
    """

    seed: int = option(0, "Seed of all random numbers.", min=0)
    steps: int = option(2000, "Optimiser steps.", min=1)
    minutes: float = option(0.0, "Stop after this much training time; 0 for the steps alone.", min=0)
    frame_step: int = option(
        5, "Step between the frames of each take that are learned from; 0 for about 40 of the take.", min=0
    )
    views_per_step: int = option(4, "Cameras rendered for each pass of the networks.", min=1)
    image_scale: float = option(1.0, "Learn from smaller images; 1 is full size.", min=0.05, max=1.0)
    coarse_scale: float = 0.25
    coarse_until: float = 0.3
    patch: int = option(
        0,
        "Each step sees a crop of PX x PX of every image at full resolution, drawn where the person and the "
        "edges of garments are; 0 for whole images. For large images.",
        min=0, metavar="PX", omit_default=True,
    )  # fmt: skip
    exposure: str = option(
        "auto",
        "auto: colours are learned as the median camera shows them; gain and offset of cameras that differ "
        "are stored | off.",
        choices=("auto", "off"),
    )
    flow_until: float = 0.6
    stage_two: float = 0.2
    rate_end: float = 0.05
    clip: float = 1.0
    label_kind: str = "l1"
    penetration_margin: float = 0.005
    penetration_every: int = field(default=1, metadata={"omit_default": True})
    perceptual_side: int = 512
    perceptual_digest: str = ""
    weights: LossWeights = field(default_factory=LossWeights)
    rates: LearningRates = field(default_factory=LearningRates)
    track: TrackConfig = field(default_factory=TrackConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    method: str = option(
        DEFAULT_METHOD,
        "gaussian-wardrobe; or a baseline: animatable-gaussians (one layer, shape kept), layga (body and one "
        "clothing layer on its surface; an approximation).",
    )
    without: tuple[str, ...] = option((), "Ablation: parts to leave out.", metavar="PARTS")
    takes: tuple[str, ...] = field(default=(), metadata={"omit_default": True})
    from_layers: tuple[str, ...] = option(
        (),
        "With --from-subject: only these layers; body alone where another shirt is worn under the garment.",
        metavar="LAYERS", omit_default=True,
    )  # fmt: skip
    recompute: bool = option(
        False,
        "Compute the networks' activations again in the backward pass instead of keeping them: the same "
        "result in less memory, for about a third more time in the networks.",
        flag="--recompute", affects_result=False,
    )  # fmt: skip
    device: str = option("auto", "auto | cpu | cuda.", choices=("auto", "cpu", "cuda"), affects_result=False)


_ECONOMY = LossWeights(
    ssim=1.0,
    penetration=50.0,
    offset=0.005,
    smooth=0.0005,
    opacity=0.005,
    seam=0.00002,
    flow=10.0,
    covered_skin=0.02,
)
_TRACKED = TrackConfig(frame_step=1, collision=3.0)
DRAFT = TrainConfig(
    frame_step=0,
    penetration_every=4,
    perceptual_side=128,
    weights=_ECONOMY,
    rates=LearningRates(anchors=4e-4, offset=5e-5),
    track=_TRACKED,
    model=ModelConfig(
        pose_prior=20, networks="none", anchors=40, anchor_cell=2, anchor_widths="own", history=3
    ),
)
PRESETS: dict[str, TrainConfig] = {
    "tiny": replace(
        DRAFT,
        steps=20,
        views_per_step=2,
        image_scale=0.5,
        perceptual_side=64,
        track=TrackConfig(),
        model=ModelConfig(pose_prior=20, width=0.0625, depth=2, style=16, factor=4, anchors=8),
    ),
    "draft": DRAFT,
    "balanced": replace(
        DRAFT,
        steps=8000,
        frame_step=1,
        perceptual_side=256,
        model=replace(DRAFT.model, networks="garments", anchors=100),
    ),
    "paper": TrainConfig(
        steps=300_000,
        frame_step=1,
        views_per_step=1,
        coarse_until=0.0,
        stage_two=0.5,
        clip=5e-4,
        weights=LossWeights(),
        rates=LearningRates(network=1.5e-4),
        model=PAPER_MODEL,
    ),
}


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
    "reg": "regularisers: offset, smoothing, seam, body opacity, covered skin",
    "pe": "penetration: the loss between layers, and collisions in tracking",
    "bs": "silhouette of the body",
    "ssim": "SSIM of the pictures",
    "lpips": "LPIPS of subject and face",
    "flow": "optical flow from render to image",
    "coarse": "coarse-to-fine pictures",
    "tracking": "tracking of the garments through the take",
    "history": "recent motion as an input",
    "anchors": "offsets of key poses",
    "base": "free attributes per texel",
    "prior": "projection of unusual poses",
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
