"""Settings of `gw evaluate`; light."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option

SPLITS = ("novel-pose", "novel-view", "novel-both")
METHODS = ("trained", "baseline", "distilled")


@dataclass(frozen=True)
class EvaluateConfig:
    """Which views are scored, and what is scored on them.

    Attributes:
        splits: "novel-pose" (test takes, training cameras), "novel-view" (training take, held-out cameras),
            "novel-both" (test takes, held-out cameras).
        methods: "trained", "distilled" (its blendshapes), and "baseline": the layers' meshes with projected
            colours, moved by the bones.
        frame_step: step between frames of the training take for novel views.
        test_frame_step: the same for test takes. cameras: largest number per frame; 0 for all.
        training: beginning of the key of the training that is scored; "" for the one in use.
        pictures: side-by-side pictures per split.
        supersampling: rays per pixel and axis of the baseline's render.
        drive: what moves garments in test takes, as `gw render --drive`; "auto" is each garment's default.
            In training takes "auto" is "learned".
        shard: "i/n", the part of the frames that this run scores; "" for all.
    """

    splits: tuple[str, ...] = option(
        SPLITS[:2],
        "Of novel-pose, novel-view, novel-both (test poses, held-out cameras). Default: what there is.",
        flag="--split",
        panel="What is scored",
    )
    methods: tuple[str, ...] = option(
        ("trained", "baseline"), "Of trained, baseline, distilled.", panel="What is scored"
    )
    frame_step: int = option(5, "Novel views: step between training frames.", min=1, panel="What is scored")
    test_frame_step: int = option(1, "Novel poses: step between test frames.", min=1, panel="What is scored")
    cameras: int = option(
        0, "Largest number of cameras of each frame; 0 for all.", min=0, panel="What is scored"
    )
    training: str = option(
        "",
        "Score this training (folder name in SUBJECT/train, or its start).",
        metavar="KEY",
        panel="What is scored",
    )
    pictures: int = 4
    supersampling: int = 2
    drive: str = option(
        "auto",
        "What moves garments in unseen poses: auto | bones | learned | simulated; by layer: "
        "lower=bones,upper=learned.",
        panel="What is scored",
    )
    shard: str = option(
        "",
        "Only the i-th of n parts of the frames, as 2/4; see below.",
        metavar="I/N",
        affects_result=False,
        panel="What is scored",
    )


PRESETS: dict[str, EvaluateConfig] = {
    "tiny": EvaluateConfig(pictures=2, supersampling=1),
    "draft": EvaluateConfig(),
    "balanced": EvaluateConfig(),
    "paper": EvaluateConfig(),
}
