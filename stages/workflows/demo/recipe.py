"""The demo as a list of commands: what a user would type, in order, with what each leaves to look at."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from stages.workflows.demo.config import DemoConfig


@dataclass(frozen=True)
class DemoStep:
    """One command of the demo.

    Attributes:
        title: heading on the page.
        sentence: what it does, in one sentence.
        arguments: the command line after `gw`, paths relative to the demo folder.
        outputs: files or folders it must leave, relative to the demo folder.
        pictures: files worth looking at, as glob patterns relative to the demo folder.
        subject: "subject_1", "subject_2" or "" where it concerns both.
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
    """What running one step gave."""

    step: DemoStep
    seconds: float
    peak_bytes: int
    result: dict[str, object] = field(default_factory=dict)
    reused: bool = False

    def pictures(self, folder: Path) -> list[str]:
        """Existing files that match the step's patterns, relative to `folder`."""
        found: list[str] = []
        for pattern in self.step.pictures:
            found += sorted(str(path.relative_to(folder)) for path in folder.glob(pattern))
        return found


def steps(config: DemoConfig) -> list[DemoStep]:
    """The whole chain on both subjects, then the exchange: subject 2 wears subject 1's skirt."""
    chain = [_synthesise(config)]
    for subject in ("subject_1", "subject_2"):
        chain += _learn(subject, config)
    return chain + _exchange(config)


def _synthesise(config: DemoConfig) -> DemoStep:
    return DemoStep(
        "Two synthetic subjects",
        "Bodies of different shape, simulated garments, nine cameras, exact masks, labels and poses.",
        ("synth", "synthetic", "--preset", config.preset, "--seed", str(config.seed)),
        ("synthetic/subject_1", "synthetic/subject_2", "synthetic/tryon_truth"),
        ("synthetic/*.png",),
    )


def _learn(subject: str, config: DemoConfig) -> list[DemoStep]:
    preset = ("--preset", config.preset)
    train_options: tuple[str, ...] = preset + ("--seed", str(config.seed), "--device", config.device)
    if config.steps is not None:
        train_options += ("--steps", str(config.steps))
    table: list[tuple[str, str, tuple[str, ...], str]] = [
        (
            "register-template",
            "A template mesh of the first frame and the body fit; the body must lie inside the masks.",
            (f"synthetic/{subject}", "-o", subject, *preset),
            "*.png",
        ),
        (
            "canonicalize",
            "The template in the canonical pose with the subject's shape taken out.",
            (subject, *preset),
            "*.png",
        ),
        (
            "segment-layers",
            "One mesh per layer, from the label images of all cameras.",
            (subject, *preset),
            "*.png",
        ),
        (
            "bake-maps",
            "Front and back maps of each layer: every texel becomes a Gaussian.",
            (subject, *preset),
            "*.png",
        ),
        (
            "train",
            "Networks that turn the pose into Gaussian attributes, trained on the images.",
            (subject, *train_options),
            "previews/*.png",
        ),
        (
            "fit-cloth",
            "Every garment gets a simulation mesh and a material; the best driver in left-out parts becomes "
            "its default.",
            (subject, *preset, "--materials", "tight,full_skirt"),
            "*.png",
        ),
    ]
    chain = [
        DemoStep(name, sentence, (name, *arguments), (f"{subject}/{name}/current.json",),
                 (f"{subject}/{name}/*/{pattern}",), subject)
        for name, sentence, arguments, pattern in table
    ]  # fmt: skip
    chain.append(
        DemoStep(
            "evaluate",
            "Held-out poses and the held-out camera, beside the template that learned nothing.",
            ("evaluate", subject, "-o", f"evaluation/{subject}", *preset),
            (f"evaluation/{subject}",),
            (f"evaluation/{subject}/*.png",),
            subject,
        )
    )
    return chain


def _exchange(config: DemoConfig) -> list[DemoStep]:
    exports = [
        DemoStep(
            "export-garment",
            f"The {layer} layer of {subject} as one file.",
            ("export-garment", subject, "--layer", layer, "-o", f"wardrobe/{name}.gwg"),
            (f"wardrobe/{name}.gwg",),
            (),
            subject,
        )
        for subject, layer, name in (
            ("subject_1", "lower", "skirt"),
            ("subject_2", "upper", "shirt"),
            ("subject_2", "outer", "vest"),
            ("subject_2", "body", "body_2"),
            ("subject_1", "body", "body_1"),
            ("subject_1", "upper", "top"),
            ("subject_2", "lower", "trousers"),
        )
    ]
    outfit = tuple(f"wardrobe/{name}.gwg" for name in ("body_2", "shirt", "vest", "skirt"))
    swapped = tuple(f"wardrobe/{name}.gwg" for name in ("body_2", "top", "trousers"))
    showcase = ("--poses", "synthetic/motions/showcase.npz", "--preset", config.preset)
    motion = ("--poses", "synthetic/motions/held_out.npz")
    return [
        *exports,
        DemoStep(
            "tryon",
            "Subject 2 in subject 1's skirt, with its own shirt and vest, in a motion of no training take.",
            ("tryon", *outfit, *showcase, "--frames", "0:120", "-o", "tryon"),
            ("tryon/result.json",),
            ("tryon/*.mp4", "tryon/*.webm", "tryon/contact_sheet.png"),
        ),
        DemoStep(
            "change of clothes",
            "The same motion goes on; subject 2 wears its trousers and subject 1's T-shirt.",
            ("tryon", *swapped, *showcase, "--frames", "120:210", "-o", "tryon_changed"),
            ("tryon_changed/result.json",),
            ("tryon_changed/*.mp4", "tryon_changed/*.webm"),
        ),
        DemoStep(
            "wardrobe",
            "Both bodies in every set of the five garments that go together, from the front and the back.",
            ("wardrobe", "outfits", "wardrobe", *motion, "-o", "outfits"),
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
            ("evaluate", "--frames", "tryon_cameras", "--truth", "synthetic/tryon_truth",
             "-o", "evaluation/tryon"),
            ("evaluation/tryon",),
            ("evaluation/tryon/*.png",),
        ),
    ]  # fmt: skip
