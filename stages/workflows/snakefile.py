"""The stage table as a Snakefile: one rule per stage, one job per subject and stage.

The output of a rule is the stage's `current.json`. `gw` replaces it atomically when an artifact is complete,
so a killed job leaves no partial result. `gw` knows what is up to date. Snakemake decides machine and order.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from stages.pipeline import PIPELINE
from stages.shared.artifacts.spec import StageSpec
from stages.shared.errors import MissingInput, UsageProblem

# Threads, memory and time a job asks for; multiplied on every retry.
_RESOURCES = {"train": (2, 4000, 240)}
_DEFAULT = (2, 3000, 60)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

_HEADER = '''"""Made by `gw pipeline --emit snakefile`. Run: snakemake --cores 2, or with a Slurm profile."""

CAPTURES = {captures}
WORKSPACES = {workspaces}
PRESET = config.get("preset", {preset})


rule all:
    input:
        expand(WORKSPACES + "/{{subject}}/{last}/current.json", subject=CAPTURES),
'''

_RULE = """

rule {rule}:
    input:
{inputs}
    output:
        update(WORKSPACES + "/{{subject}}/{stage}/current.json"),
    log:
        WORKSPACES + "/logs/{{subject}}.{stage}.log",
    threads: {threads}
    resources:
        mem_mb=lambda wildcards, attempt: {memory} * attempt,
        runtime=lambda wildcards, attempt: {minutes} * attempt,
    params:
        capture=lambda wildcards: CAPTURES[wildcards.subject],
        subject=lambda wildcards: WORKSPACES + "/" + wildcards.subject,
    shell:
        "{command} > {{log:q}} 2>&1"
"""


def subjects(captures: Sequence[Path]) -> dict[str, str]:
    """Name of each subject (the folder name of its capture) and the path of its capture.

    Raises:
        MissingInput: a capture does not exist. UsageProblem: an invalid folder name, or one name twice.
    """
    places: dict[str, str] = {}
    for capture in captures:
        if not capture.is_dir():
            raise MissingInput("There is no such capture.", str(capture), "Give folders of captures.")
        name = capture.resolve().name
        if not _NAME.fullmatch(name) or name in places:
            raise UsageProblem(
                f"{name!r} cannot be the name of a subject here, or stands twice.",
                str(capture),
                "Give captures whose folders have different names of letters, digits, dot, dash.",
            )
        places[name] = str(capture)
    return places


def snakefile(captures: Mapping[str, str], workspaces: str, preset: str) -> str:
    """Text of a Snakefile that runs all stages on every capture."""
    listed = "".join(f"    {_quoted(name)}: {_quoted(place)},\n" for name, place in captures.items())
    header = _HEADER.format(
        captures=f"{{\n{listed}}}",
        workspaces=_quoted(workspaces),
        preset=_quoted(preset),
        last=PIPELINE[-1].name,
    )
    return header + "".join(_rule(spec) for spec in PIPELINE)


def _quoted(text: str) -> str:
    """A Python string literal in double quotes. JSON literals are valid in Python."""
    return json.dumps(text, ensure_ascii=False)


def _rule(spec: StageSpec) -> str:
    threads, memory, minutes = _RESOURCES.get(spec.name, _DEFAULT)
    inputs = [f'        WORKSPACES + "/{{subject}}/{read}/current.json",' for read in spec.reads]
    if not spec.reads:
        inputs = ["        lambda wildcards: CAPTURES[wildcards.subject],"]
    words = {"SUBJECT": "{params.subject:q}", "CAPTURE": "{params.capture:q}"}
    command = " ".join(words.get(word, word) for word in spec.command.split()) + " --preset {PRESET:q}"
    return _RULE.format(
        rule=spec.name.replace("-", "_"),
        inputs="\n".join(inputs),
        stage=spec.name,
        threads=threads,
        memory=memory,
        minutes=minutes,
        command=command,
    )
