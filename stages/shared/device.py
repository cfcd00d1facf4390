"""The values of `--device`."""

from __future__ import annotations

from stages.shared.errors import UsageProblem

DEVICES = ("auto", "cpu", "cuda")


def check_device(name: str) -> None:
    """Raise UsageProblem for a name that is not in `DEVICES`, and for CUDA on a machine without it."""
    if name not in DEVICES:
        raise UsageProblem(f"There is no device {name!r}.", "option --device", "Choose auto, cpu or cuda.")
    if name != "cuda":
        return
    import torch

    if not torch.cuda.is_available():
        raise UsageProblem("No CUDA device was found.", "option --device", "Use --device cpu.")
