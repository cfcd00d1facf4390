"""Make `requirements.lock` again, after `constraints.txt` has changed (Linux x86-64, Python 3.11):

pip install --dry-run --ignore-installed --no-deps --report report.json -r constraints.txt
python -m tests.release.make_lock report.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

LOCK = Path(__file__).resolve().parents[2] / "requirements.lock"
HEADER = """\
# Every file that CI ran with, by its hash: Linux x86-64, Python 3.11, torch for CPUs.
# Made by tests/release/make_lock.py.
# pip install --require-hashes --no-deps -r requirements.lock
#     --extra-index-url https://download.pytorch.org/whl/cpu
"""


def lock_of(report: Path) -> str:
    """The lock that belongs to what pip says it would install."""
    rows = []
    for entry in json.loads(report.read_bytes())["install"]:
        about, hashes = entry["metadata"], entry["download_info"]["archive_info"]["hashes"]
        rows.append(f"{about['name'].lower()}=={about['version']} --hash=sha256:{hashes['sha256']}")
    return HEADER + "\n".join(sorted(rows)) + "\n"


if __name__ == "__main__":
    LOCK.write_text(lock_of(Path(sys.argv[1])))
