"""No code of ours unpickles, evaluates, or loads objects; one program, run apart, reads pickles."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
QUARANTINE = ROOT / "stages/shared/capture/quarantine.py"
MODULES = {"pickle", "cPickle", "_pickle", "dill", "joblib", "shelve", "marshal", "yaml", "cloudpickle"}
CALLS = {"eval", "exec", "compile", "__import__"}
METHODS = {("torch", "load"), ("torch", "save"), ("np", "loadtxt")}


def findings(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] in MODULES]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in MODULES:
            found.append(str(node.module))
        elif isinstance(node, ast.Call):
            function = node.func
            if isinstance(function, ast.Name) and function.id in CALLS:
                found.append(function.id)
            if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name):
                name = (function.value.id, function.attr)
                found += [".".join(name)] * (name in METHODS)
            for keyword in node.keywords:
                if keyword.arg == "allow_pickle" and not (
                    isinstance(keyword.value, ast.Constant) and keyword.value.value is False
                ):
                    found.append("allow_pickle")
    return found


def test_no_unsafe_calls() -> None:
    files = [*ROOT.glob("stages/**/*.py"), *ROOT.glob("gw_cli/**/*.py")]
    assert len(files) > 20
    found = {str(path.relative_to(ROOT)): findings(path) for path in files if path != QUARANTINE}
    assert not {path: names for path, names in found.items() if names}


def test_the_check_can_find_something(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text(
        "import pickle\nfrom yaml import load\ntorch.load('x')\nnp.load('x', allow_pickle=True)\neval('1')\n"
    )
    assert sorted(findings(bad)) == ["allow_pickle", "eval", "pickle", "torch.load", "yaml"]
    assert "pickle" in findings(QUARANTINE)


def test_nobody_imports_the_quarantine() -> None:
    """It is run by path in a process of its own."""
    for path in [*ROOT.glob("stages/**/*.py"), *ROOT.glob("gw_cli/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in getattr(node, "names", []) if isinstance(node, ast.Import)]
            names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.endswith("quarantine") for name in names), path
