"""The code blocks of README and docs: every block of every page, with its kind."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
GENERATED = ("commands.md", "stability.md")
PAGES = [
    REPOSITORY / "README.md",
    *sorted(page for page in (REPOSITORY / "docs").glob("*.md") if page.name not in GENERATED),
]
SHELL = ("sh", "bash", "console", "shell")
PROGRAMS = ("gw", "make", "snakemake", "torchrun")
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"(?<=\n\n)((?: {4}\S.*\n)+)")


@dataclass(frozen=True)
class Block:
    """A block of a page. kind: "shell", the language of the fence, or "" for plain text."""

    page: str
    kind: str
    text: str

    @property
    def commands(self) -> list[str]:
        """Command lines without comments. Continued lines are joined."""
        lines = [
            re.sub(r"\s+#.*$", "", line).removeprefix("$ ").strip()
            for line in self.text.replace("\\\n", " ").split("\n")
        ]
        return [line for line in lines if line and not line.startswith("#")]


def blocks(page: Path) -> list[Block]:
    """Blocks of a page: the fenced ones, then the indented ones."""
    text = page.read_text()
    marked = [(match[1], match[2]) for match in _FENCED.finditer(text)]
    marked += [("", match[1]) for match in _INDENTED.finditer(_FENCED.sub("", text))]
    return [Block(page.name, _kind(language, content), content) for language, content in marked]


def _kind(language: str, content: str) -> str:
    first = content.split(maxsplit=1)[0] if content.strip() else ""
    return "shell" if language in SHELL or (language in ("", "text") and first in PROGRAMS) else language


def inline(page: Path) -> list[str]:
    """Commands with options inside sentences, such as `gw train SUBJECT --minutes 10`."""
    return [text for text in re.findall(r"`(gw [^`]+)`", page.read_text()) if " -" in text]
