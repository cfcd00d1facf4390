"""Every file, function and heading that README and docs name exists."""

from __future__ import annotations

import ast
import importlib
import itertools
import operator
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from stages.train.config import PRESETS
from tests.docs.pages import PAGES, REPOSITORY

OURS = ("stages", "gw_cli", "tests", "docs", ".ci")
FILES = {
    path.relative_to(REPOSITORY).as_posix(): path
    for folder in OURS
    for path in (REPOSITORY / folder).rglob("*")
    if path.is_file() and "__pycache__" not in path.parts
}
# Suffixes of data files, which are not source files.
USERS = (
    "json",
    "jsonl",
    "npz",
    "npy",
    "png",
    "mp4",
    "webm",
    "ply",
    "safetensors",
    "txt",
    "md",
    "html",
    "pkl",
)
# Names of other programs, and names with a placeholder.
FOREIGN = ("http.server", "vX.Y.Z", "features.N.weight", "features.N.bias")


def prose(page: Path) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def marked(page: Path) -> list[str]:
    """Text between backticks in sentences and tables."""
    return re.findall(r"`([^`\n]+)`", prose(page))


def alternatives(path: str) -> Iterator[str]:
    """a/{b,c}/d -> a/b/d, a/c/d"""
    choices = [
        part[1:-1].split(",") if part[:1] == "{" else [part] for part in re.split(r"(\{[^}]*\})", path)
    ]
    return ("".join(words) for words in itertools.product(*choices))


def is_there(path: str) -> bool:
    """Whether a path exists from the root of the repository, or is the end of a path in it."""
    path = path.rstrip("/*").rstrip("/")
    return (REPOSITORY / path).exists() or any(name.endswith(f"/{path}") for name in FILES)


def defined(module: str, name: str) -> bool:
    """Whether a module of that (last) name defines a function, class or constant of that name."""
    for known, path in FILES.items():
        if known.endswith(f"/{module}.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if getattr(node, "name", None) == name:
                    return True
    return False


def paths_named() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        for word in marked(page):
            if re.fullmatch(r"[\w.*{},/-]+", word) and (
                word.endswith(".py") or (word.split("/")[0] in OURS and "/" in word)
            ):
                found.append((page.name, word))
    return found


def dotted_named() -> list[tuple[str, str]]:
    return [
        (page.name, word)
        for page in PAGES
        for word in marked(page)
        if re.fullmatch(r"[a-z_]\w*(\.[A-Za-z_]\w*)+", word)
        and word.rsplit(".", 1)[1] not in USERS
        and word not in FOREIGN
        and not (word.endswith(".py") or (REPOSITORY / word).is_file())
    ]


def test_there_is_something_to_look_at() -> None:
    assert len(paths_named()) > 60 and len(dotted_named()) > 8


@pytest.mark.parametrize(("page", "path"), sorted(set(paths_named())))
def test_a_path_is_there(page: str, path: str) -> None:
    assert all(is_there(one) for one in alternatives(path)), f"{page} names {path}"


def importable(name: str) -> bool:
    """Whether a full name is a module, or a name in a module."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        return all(hasattr(found, part) for part in parts[count:])
    return False


def is_setting(name: str) -> bool:
    """Whether a name is a field of the training configuration."""
    try:
        operator.attrgetter(name)(PRESETS["draft"])
    except AttributeError:
        return False
    return True


@pytest.mark.parametrize(("page", "name"), sorted(set(dotted_named())))
def test_a_name_is_there(page: str, name: str) -> None:
    """Full names are imported. `module.function` is searched in every module of that name."""
    module, _, last = name.rpartition(".")
    found = importable(name) if name.startswith("stages.") else is_setting(name) or defined(module, last)
    assert found, f"{page} names {name}"


def test_what_is_gone_is_missed() -> None:
    assert is_there("stages/train/config.py") and is_there("kernels/blend.py") and is_there("stages/shared/*")
    assert not is_there("stages/train/konfig.py") and not is_there("blendet.py")
    assert defined("kinematics", "skin") and not defined("kinematics", "skinned")
    assert importable("stages.shared.finite.finite") and not importable("stages.shared.finite.infinite")
    assert is_setting("model.networks") and not is_setting("model.network")
    assert list(alternatives("a/{b,c}/d")) == ["a/b/d", "a/c/d"]


def heading_anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page: lower case, dashes for spaces, no other characters."""
    return {
        re.sub(r"[^\w -]", "", title.strip().lower()).replace(" ", "-")
        for title in re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith(("http://", "https://")):
            continue
        place, _, anchor = target.partition("#")
        file = (page.parent / place).resolve() if place else page
        assert file.exists(), f"{page.name} leads to {target}"
        if anchor:
            assert anchor in heading_anchors(file), f"{page.name} leads to {target}"


def test_every_page_can_be_found_from_the_readme() -> None:
    """Every page is reachable by links from the README."""
    reached: set[Path] = set()
    following = [REPOSITORY / "README.md"]
    while following:
        page = following.pop()
        reached.add(page)
        targets = re.findall(r"\]\(([^)#]+\.md)", page.read_text())
        paths = {(page.parent / target).resolve() for target in targets if "://" not in target}
        following += [path for path in paths if path not in reached and path.is_file()]
    assert {page.name for page in (REPOSITORY / "docs").glob("*.md")} <= {path.name for path in reached}


def test_troubleshooting_knows_what_the_program_says() -> None:
    """Quoted messages occur in the sources, ignoring case."""
    programs = [path for name, path in FILES.items() if re.match(r"(stages|gw_cli)/.*\.py$", name)]
    sources = re.sub(r'"\s*f?"', "", " ".join(path.read_text() for path in programs)).lower()
    table = (REPOSITORY / "docs/troubleshooting.md").read_text()
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| ")]
    quoted = [text for row in rows for text in re.findall(r"\*([^*]+)\*", row)]
    assert len(quoted) >= 4
    for text in quoted:
        assert text.lower() in sources, text
