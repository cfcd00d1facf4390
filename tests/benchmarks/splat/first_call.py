"""How long the first call takes in a new process: kernels read from disk, or compiled.

`python -m tests.benchmarks.splat.first_call` writes one JSON object; `measure_first_call` runs that.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any


def measure_first_call(cold: bool) -> dict[str, Any]:
    """{"seconds", "compiled"} of a child process that renders forward and backward for the first time.

    cold: with an empty folder for compiled code; else with the user's own. Imports are not counted.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = dict(os.environ, **({"NUMBA_CACHE_DIR": folder} if cold else {}))
        command = [sys.executable, "-m", __spec__.name]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def main() -> None:
    """Time `warm_up` and write the result."""
    from stages.shared.splat import cpu
    from stages.shared.splat.kernels.compiling import compilations

    started = time.perf_counter()
    cpu.warm_up()
    found = {"seconds": time.perf_counter() - started, "compiled": compilations() > 0}
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main()
