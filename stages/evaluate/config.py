"""Settings and inputs of `gw evaluate`. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.shared.errors import MissingInput, UsageProblem
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
        "Of novel-pose, novel-view, novel-both (test poses, held-out cameras); those that the capture has.",
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
        "What moves garments in unseen poses: auto | bones | learned | simulated | own-size; by layer: "
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


@dataclass(frozen=True)
class EvaluateInputs:
    """What is evaluated: a trained subject, rendered frames, or plain pictures.

    Attributes:
        subject: workspace of a trained subject.
        frames: output of `gw render --cameras CAPTURE`. truth is then the capture that shows the same.
        images: folder of pictures. truth is then a folder with pictures of the same names.
        masks: folder of foreground masks for `images`; None for the alpha of the truth, if it has one.
        true_meshes: true garments of a subject, as `true_meshes_of` takes them.
    """

    subject: Path | None = None
    frames: Path | None = None
    images: Path | None = None
    truth: Path | None = None
    masks: Path | None = None
    true_meshes: tuple[str, ...] = ()


def default_output(inputs: EvaluateInputs) -> Path:
    """The folder of an evaluation for which none is named."""
    if inputs.subject is not None:
        return inputs.subject / "evaluation"
    pictures = inputs.frames or inputs.images
    assert pictures is not None
    return pictures.parent / f"{pictures.name}_evaluation"


def check_inputs(inputs: EvaluateInputs) -> None:
    """Raise UsageProblem unless exactly one kind of input is given, and MissingInput for absent folders."""
    subject, truth = inputs.subject, inputs.truth
    if inputs.true_meshes and subject is None:
        raise UsageProblem(
            "True meshes are compared with a trained subject.",
            "option --true-meshes",
            "Give the subject: gw evaluate SUBJECT --true-meshes FILE.",
        )
    kinds = sum(path is not None for path in (subject, inputs.frames, inputs.images))
    masks_alone = inputs.masks is not None and inputs.images is None
    if kinds != 1 or (truth is None) != (subject is not None) or masks_alone:
        raise UsageProblem(
            "It is not clear what to evaluate.",
            "SUBJECT, --frames, --images, --truth, --masks",
            "Give a subject, or --frames DIR --truth CAPTURE, or --images DIR --truth DIR [--masks DIR].",
        )
    for folder in (inputs.frames, inputs.images, truth, inputs.masks):
        if folder is not None and not folder.is_dir():
            raise MissingInput("There is no such folder.", str(folder), "Check the path.")


PRESETS: dict[str, EvaluateConfig] = {
    "tiny": EvaluateConfig(pictures=2, supersampling=1),
    "draft": EvaluateConfig(),
    "balanced": EvaluateConfig(),
    "paper": EvaluateConfig(),
}
