"""A network file, run on the CPU."""

from __future__ import annotations

import contextlib
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import MissingInput
from stages.shared.vision.models import INSTALL

Singles = NDArray[np.float32]


class Network:
    """One LiteRT network with a single picture as its input.

    Attributes:
        side: width and height of the input, pixels.
    """

    def __init__(self, content: bytes, threads: int = 2) -> None:
        try:
            from ai_edge_litert.interpreter import Interpreter
        except ImportError as error:
            raise MissingInput(
                "The runtime of the networks is not installed.", f"ai-edge-litert: {error}", INSTALL + "."
            ) from error
        with _quiet():
            self._interpreter: Any = Interpreter(model_content=content, num_threads=threads)
            self._interpreter.allocate_tensors()
        (entry,) = self._interpreter.get_input_details()
        self._input = entry["index"]
        self.side = int(entry["shape"][1])
        self._outputs = [
            (one["index"], tuple(one["shape"])) for one in self._interpreter.get_output_details()
        ]

    def __call__(self, picture: Singles) -> dict[tuple[int, ...], Singles]:
        """Outputs by shape for a picture (side, side, 3) f32."""
        self._interpreter.set_tensor(self._input, np.ascontiguousarray(picture[None], np.float32))
        self._interpreter.invoke()
        return {shape: self._interpreter.get_tensor(index) for index, shape in self._outputs}


@contextlib.contextmanager
def _quiet() -> Any:
    """The runtime greets on the error stream; people and programs read that stream."""
    silent = os.open(os.devnull, os.O_WRONLY)
    kept = os.dup(2)
    try:
        os.dup2(silent, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(silent)
        os.close(kept)
