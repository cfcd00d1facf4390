"""The page of the demo: what each command made, what it cost, and how good it is.

Writes `index.html` and `contact_sheet.png` into the demo folder; pictures and films are linked where
the stages left them, so the folder can be opened from disk or copied as a whole.
"""

from __future__ import annotations

import html
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.shared.artifacts import write_whole
from stages.shared.artifacts.pictures import encode_png
from stages.shared.pictures.sheet import contact_sheet, shrunk
from stages.workflows.demo.recipe import DemoConfig, DemoOutcome

_STYLE = """
:root { color-scheme: light dark; --ink: #1c1c1e; --paper: #fbfaf7; --line: #d9d6cf; --soft: #6a6862; --code: #f0eee8 }
@media (prefers-color-scheme: dark) { :root { --ink: #ecebe7; --paper: #17181a; --line: #34363a; --soft: #a09e98; --code: #222428 } }
body { margin: 0 auto; max-width: 70rem; padding: 2rem 1.25rem 5rem; background: var(--paper); color: var(--ink);
       font: 16px/1.55 system-ui, sans-serif }
h1 { font-size: 1.9rem; margin: 0 } h2 { margin: 3rem 0 .5rem; font-size: 1.25rem }
p.soft, td.soft, figcaption { color: var(--soft) }
code { display: block; overflow-x: auto; background: var(--code); padding: .5rem .75rem; border-radius: .4rem; font-size: .88rem }
video, img { max-width: 100%; height: auto; border-radius: .4rem; display: block; background: #808080 }
table { border-collapse: collapse; margin: .75rem 0; font-variant-numeric: tabular-nums; font-size: .92rem }
th, td { text-align: right; padding: .25rem .8rem; border-bottom: 1px solid var(--line) }
th:first-child, td:first-child { text-align: left }
section { border-top: 1px solid var(--line); padding-top: 1rem; margin-top: 1.5rem }
details { margin-top: .75rem } summary { cursor: pointer }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(18rem, 1fr)); gap: 1rem; margin-top: .75rem }
figure { margin: 0 } iframe { width: 100%; height: 36rem; border: 0; margin-top: 1rem }
"""  # noqa: E501

_SCORES = {
    "psnr_foreground": "PSNR of the person, dB",
    "ssim_foreground": "SSIM of the person",
    "ms_ssim": "MS-SSIM of the picture",
    "flip": "FLIP (lower is better)",
    "iou": "silhouette IoU",
    "miou": "layer mIoU",
    "sharpness": "sharpness (truth is 1)",
}
_GO_ON = {
    "Watch outfits live in the browser":
        "gw view --wardrobe wardrobe --poses synthetic/motions/showcase.npz",
    "A motion of your own (SMPL-X, AMASS or BVH)":
        "gw tryon wardrobe/body_1.gwg wardrobe/skirt.gwg wardrobe/top.gwg --poses walk.bvh -o walk",
    "A page that turns without a server":
        "gw render wardrobe/body_2.gwg wardrobe/skirt.gwg wardrobe/shirt.gwg --html outfit.html",
    "Your own capture":
        "gw register-template CAPTURE -o SUBJECT",
}  # fmt: skip


def write_page(folder: Path, config: DemoConfig, outcomes: list[DemoOutcome], seconds: float) -> Path:
    """Write `index.html` and `contact_sheet.png`; return the page's path. `seconds`: of the whole run."""
    _write_contact_sheet(folder, outcomes)
    before = sum(outcome.reused for outcome in outcomes)
    body = [
        "<h1>Gaussian Wardrobe: the demo</h1>",
        f'<p class="soft">Preset {html.escape(config.preset)}, seed {config.seed}. '
        f"{len(outcomes)} commands, {before} of them done before; this run took {seconds / 60:.1f} minutes. "
        "Nothing was downloaded: both people are synthetic.</p>",
        _films(folder, outcomes),
        _clip(folder),
        _outfits(folder, outcomes),
        "<h2>How good is it?</h2>",
        "<p>A novel view is a camera that was held out, a novel pose a motion that training did not see. "
        "The baseline has learned nothing: it is the template with the colours of its frame, moved by "
        "the bones.</p>",
        _score_table(outcomes),
        "<h2>Go on from here</h2>",
        *[f"<p>{html.escape(text)}</p><code>{html.escape(line)}</code>" for text, line in _GO_ON.items()],
        "<h2>What was run</h2>",
        '<figure><img src="contact_sheet.png" alt="One picture per stage">'
        "<figcaption>One picture of each stage.</figcaption></figure>",
        f"<details><summary>Seconds and memory</summary>{_cost_table(outcomes)}</details>",
        "<details><summary>Every command</summary>",
        *[_section(folder, outcome) for outcome in outcomes],
        "</details>",
    ]
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Gaussian Wardrobe: the demo</title><style>{_STYLE}</style></head><body>"
        + "\n".join(body)
        + "</body></html>\n"
    )
    path = folder / "index.html"
    write_whole(path, page.encode())
    return path


def _films(folder: Path, outcomes: list[DemoOutcome]) -> str:
    """The films of the try-on side by side."""
    figures = [
        f'<figure><video src="{html.escape(picture)}" controls loop muted autoplay playsinline></video>'
        f"<figcaption>{html.escape(outcome.step.sentence)}</figcaption></figure>"
        for outcome in outcomes
        for picture in outcome.pictures(folder)
        if picture.endswith((".mp4", ".webm"))
    ]
    return f'<div class="pictures">{"".join(figures)}</div>'


def _clip(folder: Path) -> str:
    """The clip that can be turned while it plays."""
    if not (folder / "clip.html").exists():
        return ""
    return (
        '<iframe src="clip.html" title="the try-on, to be turned" loading="lazy"></iframe>'
        '<p class="soft">Drag to look from another side. <a href="clip.html">On a page of its own</a>.</p>'
    )


def _write_contact_sheet(folder: Path, outcomes: list[DemoOutcome]) -> None:
    """The last picture of each step that left one, in order."""
    pictures, captions = [], []
    for outcome in outcomes:
        names = [name for name in outcome.pictures(folder) if name.endswith(".png")]
        picture = cv2.imread(str(folder / names[-1]), cv2.IMREAD_COLOR) if names else None
        if picture is not None:
            pictures.append(shrunk(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8), 480))
            captions.append(f"{outcome.step.title} {outcome.step.subject}".strip())
    if pictures:
        write_whole(folder / "contact_sheet.png", encode_png(contact_sheet(pictures, 4, captions)))


def _outfits(folder: Path, outcomes: list[DemoOutcome]) -> str:
    """The sheet of all outfits, as wide as the page."""
    return "".join(
        f'<figure><a href="{html.escape(picture)}"><img src="{html.escape(picture)}" alt="every outfit"></a>'
        f"<figcaption>{html.escape(outcome.step.sentence)}</figcaption></figure>"
        for outcome in outcomes
        for picture in outcome.pictures(folder)
        if picture.startswith("outfits/")
    )


def _score_table(outcomes: list[DemoOutcome]) -> str:
    """One row per evaluation and method; a score that could not be computed is a dash."""
    rows = []
    for outcome in outcomes:
        if outcome.step.arguments[0] != "evaluate":
            continue
        for name, scores in _score_rows(outcome.result):
            label = " ".join(filter(None, (outcome.step.subject or "try-on", name))).replace("_", " ")
            cells = "".join(f"<td>{_number(scores.get(score))}</td>" for score in _SCORES)
            rows.append(f"<tr><td>{html.escape(label)}</td>{cells}</tr>")
    head = "".join(f"<th>{html.escape(title)}</th>" for title in _SCORES.values())
    return f"<table><tr><th></th>{head}</tr>{''.join(rows)}</table>"


def _score_rows(result: dict[str, Any], prefix: str = "") -> list[tuple[str, dict[str, Any]]]:
    """Every dictionary of scores inside `result`, with the path that leads to it."""
    if "psnr_foreground" in result:
        return [(prefix, result)]
    rows = []
    for name, value in result.items():
        if isinstance(value, dict):
            rows += _score_rows(value, f"{prefix} {name}".strip())
    return rows


def _number(value: Any) -> str:
    if isinstance(value, int | float) and math.isfinite(value):
        return f"{value:.2f}" if abs(value) >= 2 else f"{value:.3f}"
    return "–"


def _cost_table(outcomes: list[DemoOutcome]) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(outcome.step.title)}</td><td>{html.escape(outcome.step.subject)}</td>"
        f"<td>{outcome.seconds:.1f}</td><td>{outcome.peak_bytes / 2**20:.0f}</td></tr>"
        for outcome in outcomes
    )
    return f"<table><tr><th>step</th><th></th><th>seconds</th><th>peak MiB</th></tr>{rows}</table>"


def _section(folder: Path, outcome: DemoOutcome) -> str:
    title = " · ".join(filter(None, (outcome.step.title, outcome.step.subject)))
    figures = "".join(_figure(picture) for picture in outcome.pictures(folder)[-2:])
    return (
        f"<section><h2>{html.escape(title)}</h2><p>{html.escape(outcome.step.sentence)}</p>"
        f"<code>{html.escape(outcome.step.command)}</code>"
        f'<div class="pictures">{figures}</div></section>'
    )


def _figure(picture: str) -> str:
    source = html.escape(picture)
    if picture.endswith((".mp4", ".webm")):
        return f'<figure><video src="{source}" controls loop muted playsinline></video></figure>'
    return (
        f'<figure><a href="{source}"><img loading="lazy" src="{source}" alt=""></a>'
        f"<figcaption>{html.escape(Path(picture).name)}</figcaption></figure>"
    )
