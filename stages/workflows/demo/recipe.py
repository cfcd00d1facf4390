"""The demo as a list of commands: what a user would type, in order, and the files worth looking at."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from stages.shared.option import option

SUBJECTS = ("subject_1", "subject_2")


@dataclass(frozen=True)
class DemoConfig:
    """Size and seed of the demo. The help of each field is in its metadata."""

    preset: str = "draft"
    steps: int | None = option(None, "Optimiser steps per subject; draft takes 1000 when absent.", min=1)
    seed: int = option(0, "Seed of all random numbers.", min=0)
    device: str = option("auto", "auto | cpu | cuda.", choices=("auto", "cpu", "cuda"))


PRESETS = {name: DemoConfig(name) for name in ("tiny", "draft", "balanced", "paper")}
PRESETS["draft"] = DemoConfig(steps=1000)


@dataclass(frozen=True)
class DemoStep:
    """One command of the demo.

    Attributes:
        title: heading on the page.
        sentence: what it does, in one sentence.
        arguments: the command line after `gw`, paths relative to the demo folder.
        outputs: files or folders it must leave, relative to the demo folder.
        pictures: files worth looking at, as glob patterns relative to the demo folder.
        subject: one of SUBJECTS, or "" where it concerns both.
    """

    title: str
    sentence: str
    arguments: tuple[str, ...]
    outputs: tuple[str, ...]
    pictures: tuple[str, ...] = ()
    subject: str = ""

    @property
    def command(self) -> str:
        return "gw " + " ".join(self.arguments)


@dataclass
class DemoOutcome:
    """Result of running one step."""

    step: DemoStep
    seconds: float
    peak_bytes: int
    result: dict[str, object] = field(default_factory=dict)
    reused: bool = False

    def pictures(self, folder: Path) -> list[str]:
        """Existing files that match the step's patterns, relative to `folder`."""
        return [
            str(path.relative_to(folder))
            for pattern in self.step.pictures
            for path in sorted(folder.glob(pattern))
        ]


def steps(config: DemoConfig) -> list[DemoStep]:
    """The whole chain on both subjects, then the exchange: subject 2 wears subject 1's skirt."""
    learned = [step for subject in SUBJECTS for step in learn(subject, config)]
    return [*synthesise(config), *learned, *exchange(config)]


def synthesise(config: DemoConfig) -> list[DemoStep]:
    """Both captures."""
    step = DemoStep(
        "Two synthetic subjects",
        "Bodies of different shape, simulated garments, nine cameras, exact masks, labels and poses.",
        ("synth", "synthetic", "--preset", config.preset, "--seed", str(config.seed)),
        ("synthetic/subject_1", "synthetic/subject_2", "synthetic/tryon_truth"),
        ("synthetic/*.png",),
    )
    return [step]


_STAGES = {
    "register-template": "A template mesh of the first frame, and the body that fits into the masks.",
    "canonicalize": "The template in the canonical pose with the subject's shape taken out.",
    "segment-layers": "One mesh per layer, from the label images of all cameras.",
    "bake-maps": "Front and back maps of each layer: every texel becomes a Gaussian.",
    "train": "Networks that turn the pose into Gaussian attributes, trained on the images.",
    "fit-cloth": "A simulation mesh and a material per garment; the best driver becomes its default.",
}
_BUNDLES = {
    "subject_1": {"lower": "skirt", "upper": "top", "body": "body_1"},
    "subject_2": {"upper": "shirt", "outer": "vest", "lower": "trousers", "body": "body_2"},
}


def learn(subject: str, config: DemoConfig) -> list[DemoStep]:
    """From the capture of one subject to its bundles."""
    preset = ("--preset", config.preset)
    options = {
        "register-template": (f"synthetic/{subject}", "-o", subject, *preset),
        "train": (subject, *preset, "--seed", str(config.seed), "--device", config.device),
        "fit-cloth": (subject, *preset, "--materials", "tight,full_skirt"),
    }
    if config.steps is not None:
        options["train"] += ("--steps", str(config.steps))
    chain = [
        DemoStep(
            name,
            sentence,
            (name, *options.get(name, (subject, *preset))),
            (f"{subject}/{name}/current.json",),
            (f"{subject}/{name}/*/{'previews/' if name == 'train' else ''}*.png",),
            subject,
        )
        for name, sentence in _STAGES.items()
    ]
    evaluate = DemoStep(
        "evaluate",
        "Held-out poses and the held-out camera, and the same scores of the untrained template.",
        ("evaluate", subject, "-o", f"evaluation/{subject}", *preset),
        (f"evaluation/{subject}",),
        (f"evaluation/{subject}/*.png",),
        subject,
    )
    exports = [
        DemoStep(
            "export-garment",
            f"The {layer} layer of {subject} as one file.",
            ("export-garment", subject, "--layer", layer, "-o", f"wardrobe/{name}.gwg"),
            (f"wardrobe/{name}.gwg",),
            (),
            subject,
        )
        for layer, name in _BUNDLES[subject].items()
    ]
    return [*chain, evaluate, *exports]


def exchange(config: DemoConfig) -> list[DemoStep]:
    """Subject 2 in other clothes: films, a page with a clip, every outfit, and the score of the try-on."""
    outfit = tuple(f"wardrobe/{name}.gwg" for name in ("body_2", "shirt", "vest", "skirt"))
    changed = tuple(f"wardrobe/{name}.gwg" for name in ("body_2", "top", "trousers"))
    showcase = ("--poses", "synthetic/motions/showcase.npz", "--preset", config.preset)
    motion = ("--poses", "synthetic/motions/held_out.npz")
    return [
        DemoStep(
            "tryon",
            "Subject 2 in subject 1's skirt, with its own shirt and vest, in a motion that is new to it.",
            ("tryon", *outfit, *showcase, "--frames", "0:120", "-o", "tryon"),
            ("tryon/result.json",),
            ("tryon/*.mp4", "tryon/*.webm", "tryon/contact_sheet.png"),
        ),
        DemoStep(
            "change of clothes",
            "The same motion goes on; subject 2 wears its trousers and subject 1's T-shirt.",
            ("tryon", *changed, *showcase, "--frames", "120:210", "-o", "tryon_changed"),
            ("tryon_changed/result.json",),
            ("tryon_changed/*.mp4", "tryon_changed/*.webm"),
        ),
        DemoStep(
            "clip",
            "The try-on as a page of its own: it plays, and you can look from any side.",
            ("render", *outfit, *showcase, "--frames", "0:120:2", "--html", "clip.html"),
            ("clip.html",),
        ),
        DemoStep(
            "wardrobe",
            "Both bodies in every set of the five garments that go together, from the front and the back.",
            ("wardrobe", "outfits", "wardrobe", *motion, "--drive", "learned", "-o", "outfits"),
            ("outfits/outfits.json",),
            ("outfits/outfits.png",),
        ),
        DemoStep(
            "render",
            "The same outfit from the cameras of the simulated truth.",
            ("render", *outfit, *motion, "--cameras", "synthetic/tryon_truth", "-o", "tryon_cameras"),
            ("tryon_cameras/result.json",),
        ),
        DemoStep(
            "evaluate the try-on",
            "Against the truth: the skirt simulated on subject 2's body.",
            (
                *("evaluate", "--frames", "tryon_cameras", "--truth", "synthetic/tryon_truth"),
                *("-o", "evaluation/tryon"),
            ),
            ("evaluation/tryon",),
            ("evaluation/tryon/*.png",),
        ),
    ]
