"""The methods by name."""

from __future__ import annotations

from stages.shared.errors import UsageProblem
from stages.train.methods.animatable_gaussians import AnimatableGaussians
from stages.train.methods.base import Method
from stages.train.methods.gaussian_wardrobe import GaussianWardrobe
from stages.train.methods.layga import LayGA

METHODS: dict[str, Method] = {
    method.name: method for method in (GaussianWardrobe(), AnimatableGaussians(), LayGA())
}


def method_called(name: str) -> Method:
    """A method by its name.

    Raises UsageProblem for a method that does not exist.
    """
    if name not in METHODS:
        raise UsageProblem(
            f"There is no method {name!r}.", "option --method", "Choose of: " + ", ".join(METHODS) + "."
        )
    return METHODS[name]
