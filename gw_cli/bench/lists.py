"""Lists of numbers as options."""

from __future__ import annotations

from stages.shared.errors import UsageProblem


def numbers(option: str, text: str) -> tuple[int, ...]:
    """'25k,50k' -> (25000, 50000). Raises UsageProblem for anything else."""
    try:
        return tuple(
            int(float(word.rstrip("kK")) * (1000 if word[-1:] in "kK" else 1)) for word in text.split(",")
        )
    except (ValueError, OverflowError):
        raise UsageProblem(
            f"{text!r} is not a list of numbers.", f"option --{option}", "Write for example 25k,50k."
        ) from None
