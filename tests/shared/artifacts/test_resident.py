"""A process reports its own peak, not its parent's."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from stages.shared.artifacts.resident import peak_resident_bytes, resident_bytes


def test_the_peak_is_at_least_what_was_held() -> None:
    held = np.ones(50_000_000)
    assert resident_bytes("VmRSS") > held.nbytes
    assert peak_resident_bytes() >= resident_bytes("VmRSS") - 4096 * 64


def test_a_child_does_not_count_what_its_parent_held() -> None:
    held = np.ones(50_000_000)
    program = "from stages.shared.artifacts.resident import peak_resident_bytes; print(peak_resident_bytes())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert 1_000_000 < int(done.stdout) < held.nbytes / 2
