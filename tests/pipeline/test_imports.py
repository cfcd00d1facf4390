"""Imports go one way, heavy libraries stay behind one door each, and nothing unpickles."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("gw_cli", "stages") for path in (REPOSITORY / package).rglob("*.py"))
QUARANTINE = "stages.shared.capture.quarantine"  # its child process admits plain arrays and containers only
WORKFLOWS = "stages.workflows"  # the one folder that may import several stages
HEAVY = {"torch", "open3d", "pymeshlab", "igl", "cv2", "numba", "scipy", "trimesh", "gsplat", "av", "anny"}
HELP_MODULES = 430  # `gw --help` loads 380: Python, typer, rich and the modules of the commands
ONE_DOOR = ("open3d", "pymeshlab", "gsplat")


def module_name(path: Path) -> str:
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


TREES = {module_name(path): ast.parse(path.read_text(), str(path)) for path in SOURCES}


def imported(tree: ast.AST) -> Iterator[str]:
    """Full names of everything that a tree imports, `from a import b` as both a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are written in full"
            yield str(node.module)
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imported_at_top(tree: ast.Module) -> Iterator[str]:
    """Imports that run when the module is loaded."""
    for statement in tree.body:
        if not isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield from imported(statement)


def layer(name: str) -> str:
    """`gw_cli`, `stages.<stage>` or `stages.shared.<noun>`."""
    parts = name.split(".")
    return ".".join(parts[: 1 if parts[0] == "gw_cli" else 3 if parts[1:2] == ["shared"] else 2])


def arrows() -> set[tuple[str, str]]:
    """Which layer imports which other one."""
    return {
        (layer(module), layer(target))
        for module, tree in TREES.items()
        for target in imported(tree)
        if target.split(".")[0] in ("gw_cli", "stages") and layer(module) != layer(target)
    }


def stage_packages() -> set[str]:
    """Every folder of `stages` but `shared` and `workflows`, with or without a stage.py."""
    folders = {layer(name) for name in TREES if name.startswith("stages.")} - {"stages.pipeline", WORKFLOWS}
    return {name for name in folders if not name.startswith("stages.shared")}


def circles(below: dict[str, set[str]]) -> set[str]:
    """The names that cannot be put in an order in which every arrow goes down."""
    left = set(below)
    while floor := {name for name in left if not below[name] & left}:
        left -= floor
    while roof := {name for name in left if not any(name in below[other] for other in left)}:
        left -= roof  # what only stands on a circle is not in it
    return left


def running(tree: ast.Module) -> ast.Module:
    """The tree without what only type checkers read."""

    class Dropping(ast.NodeTransformer):
        def visit_If(self, node: ast.If) -> ast.AST | None:
            return None if ast.unparse(node.test) == "TYPE_CHECKING" else node

    return Dropping().visit(ast.parse(ast.unparse(tree)))


def test_the_sources_are_there() -> None:
    assert len(TREES) > 50
    assert {"stages.canonicalize", "stages.train", "stages.evaluate"} <= stage_packages()
    assert not any("shared" in name for name in stage_packages())


def test_only_the_command_line_knows_the_command_line() -> None:
    assert [arrow for arrow in arrows() if arrow[1] == "gw_cli"] == []


def test_no_stage_imports_another() -> None:
    stages = stage_packages()
    assert [arrow for arrow in arrows() if arrow[0] in stages and arrow[1] in stages] == []


def test_no_stage_starts_the_command_line() -> None:
    assert [
        module
        for module, tree in TREES.items()
        for node in ast.walk(tree)
        if module.startswith("stages.") and isinstance(node, ast.Constant) and node.value == "gw_cli"
    ] == []


def test_only_the_command_line_imports_workflows() -> None:
    assert {upper for upper, lower in arrows() if lower == WORKFLOWS} <= {"gw_cli"}


def test_what_is_shared_imports_no_stage() -> None:
    shared = [arrow for arrow in arrows() if arrow[0].startswith("stages.shared")]
    data = ("stages", "stages.pipeline")  # the table of stages is data: names, inputs, versions
    assert [arrow for arrow in shared if arrow[1] not in data and "shared" not in arrow[1]] == []


def test_what_is_shared_imports_downwards_only() -> None:
    """No circle among the packages of `stages/shared`: then there is an order in which arrows go down."""
    below: dict[str, set[str]] = {}
    for upper, lower in arrows():
        if upper.count(".") == 2 and lower.count(".") == 2:
            below.setdefault(upper, set()).add(lower)
            below.setdefault(lower, set())
    assert circles(below) == set()


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Not even inside a function; a package that lists its modules does not count as one of them."""
    below = {
        module: {
            target
            for target in imported(running(tree))
            if target in TREES and target != module and not module.startswith(target + ".")
        }
        for module, tree in TREES.items()
    }
    assert circles(below) == set()


def test_circles_are_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == set()
    assert circles({"above": {"a"}, "a": {"b"}, "b": {"a", "below"}, "below": set()}) == {"a", "b"}
    text = "if TYPE_CHECKING:\n    import a.b\nelse:\n    pass\ndef f():\n    import c.d\n"
    assert list(imported(running(ast.parse(text)))) == ["c.d"]


def test_the_store_imports_only_errors_input_files_reports_and_tables() -> None:
    assert {lower for upper, lower in arrows() if upper == "stages.shared.artifacts"} <= {
        "stages.shared",
        "stages.shared.errors",
        "stages.shared.input_files",
        "stages.shared.layers",
        "stages.shared.report",
        "stages.shared.texel_maps",
    }


@pytest.mark.parametrize("library", ONE_DOOR)
def test_one_module_each_imports_the_difficult_libraries(library: str) -> None:
    users = {
        module for module, tree in TREES.items() if library in {name.split(".")[0] for name in imported(tree)}
    }
    assert len(users) <= 1, users
    at_top = {
        module for module in users if library in {n.split(".")[0] for n in imported_at_top(TREES[module])}
    }
    assert at_top == set(), f"{library} is imported inside a function"


def test_configurations_and_commands_load_nothing_heavy() -> None:
    light = [name for name in TREES if name.startswith("gw_cli") or name.endswith(".config")]
    assert len(light) > 5
    for module in light:
        tops = {name.split(".")[0] for name in imported_at_top(TREES[module])}
        assert not tops & (HEAVY | {"numpy"}), module


def unsafe(tree: ast.AST) -> Iterator[str]:
    """Everything that can run what a file says."""
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            if not (isinstance(node.value, ast.Constant) and node.value.value is False):
                yield "allow_pickle"
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("eval", "exec")
        ):
            yield node.func.id
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            name = f"{node.value.id}.{node.attr}"
            if name in ("torch.load", "torch.save", "torch.jit", "joblib.load", "os.system"):
                yield name
    for name in imported(tree):
        if name.split(".")[0] in (
            "pickle",
            "cPickle",
            "dill",
            "cloudpickle",
            "joblib",
            "shelve",
            "marshal",
            "yaml",
        ):
            yield name


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from pickle import loads",
        "torch.load(path)",
        "torch.save(x, path)",
        "np.load(path, allow_pickle=True)",
        "np.load(path, allow_pickle=flag)",
        "eval('1')",
        "exec(text)",
        "import yaml",
    ],
)
def test_the_search_finds_what_it_is_for(text: str) -> None:
    assert list(unsafe(ast.parse(text)))


def test_nothing_outside_the_quarantine_can_run_what_a_file_says() -> None:
    assert list(unsafe(ast.parse("np.load(path, allow_pickle=False)\nmodel.eval()"))) == []
    found = {module: list(unsafe(tree)) for module, tree in TREES.items() if module != QUARANTINE}
    assert {module: names for module, names in found.items() if names} == {}


def run_python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_by(*words: str) -> tuple[str, set[str]]:
    """What `gw WORDS` prints and the full names of the modules that it loads."""
    code = (
        f"import sys\nsys.argv = ['gw', *{words!r}]\nfrom gw_cli.app import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\nprint('LOADED', *sys.modules)"
    )
    text, modules = run_python(code).split("LOADED")
    return text, set(modules.split())


def test_help_loads_nothing_heavy() -> None:
    text, modules = loaded_by("--help")
    assert "status" in text and "verify" in text
    assert not {name.split(".")[0] for name in modules} & (HEAVY | {"numpy"})
    assert len(modules) < HELP_MODULES


MISTYPED = (
    "--nonsense",
    "trian",
    "train NONE --nonsense",
    "train NONE --preset wrong",
    "train NONE --device gpu",
    "register-template NONE -o OUT",
    "canonicalize NONE",
    "segment-layers NONE",
    "bake-maps NONE",
    "train NONE",
    "distill NONE",
    "fit-cloth NONE",
    "export-garment NONE --layer upper",
    "tryon NONE.gwg --poses NONE.npz",
    "render NONE",
    "view NONE",
    "evaluate NONE",
    "evaluate --frames NONE --truth NONE",
    "wardrobe outfits NONE",
    "poses NONE -o OUT.npz",
    "demo --preset wrong",
    "synth OUT --preset wrong",
    "bench tradeoff NONE",
    "status NONE",
    "verify NONE",
    "inspect NONE.gwg",
)


def test_a_mistyped_command_is_answered_without_heavy_libraries() -> None:
    code = (
        "import sys\nfrom typer.testing import CliRunner\nfrom gw_cli.app import app\n"
        f"for line in {MISTYPED!r}:\n"
        "    done = CliRunner().invoke(app, line.split())\n"
        "    assert done.exit_code in (2, 66) and 'fix:' in done.output, (line, done.output)\n"
        f"    heavy = sorted(set(sys.modules) & {HEAVY - {'gsplat'}!r})\n"
        "    assert not heavy, (line, heavy)\n"
    )
    run_python(code)


def test_the_store_and_the_table_of_stages_load_no_torch() -> None:
    loaded = run_python(
        "import sys, stages.pipeline, stages.shared.artifacts, stages.shared.artifacts.staleness\n"
        "import stages.shared.artifacts.verify\nprint(*sys.modules)"
    )
    assert "numpy" in loaded.split() and not {name.split(".")[0] for name in loaded.split()} & HEAVY


def test_every_stage_of_the_table_reads_only_earlier_ones() -> None:
    from stages.pipeline import PIPELINE

    for number, spec in enumerate(PIPELINE):
        assert set(spec.reads) <= {earlier.name for earlier in PIPELINE[:number]}
        assert spec.command.split()[:2] == ["gw", spec.name]
