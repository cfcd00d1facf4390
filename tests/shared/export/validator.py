"""The glTF validator of Khronos, from npm, where node and the package are installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

_SCRIPT = """
const validator = require(process.argv[1] + "/gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])))
  .then((report) => console.log(JSON.stringify(report)));
"""


def gltf_validator_report(path: Path) -> dict[str, Any]:
    """The validator's report about a file; without node or the package the test is skipped.

    The package is looked for in the folder `NODE_MODULES`, else among npm's global packages.
    """
    node, npm = shutil.which("node"), shutil.which("npm")
    modules = os.environ.get("NODE_MODULES", "")
    if not modules and npm:
        modules = subprocess.run(
            [npm, "root", "-g"], capture_output=True, text=True, timeout=60
        ).stdout.strip()
    if node is None or not (Path(modules) / "gltf-validator").is_dir():
        pytest.skip("no glTF validator on this machine: npm install -g gltf-validator")
    words = [node, "-e", _SCRIPT, modules, str(path)]
    return dict(json.loads(subprocess.run(words, capture_output=True, check=True, timeout=60).stdout))
