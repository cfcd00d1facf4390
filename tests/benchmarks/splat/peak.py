"""The most multiply-adds a core can do: the yardstick of `python -m tests.benchmarks.splat`."""

from __future__ import annotations

from stages.shared.splat.kernels.compiling import kernel
from stages.shared.splat.kernels.memory import load, next_item, store
from stages.shared.splat.kernels.simd import fma

# mypy: ignore-errors
# (compiled and type-checked by numba)

CHAINS = 12


@kernel
def multiply_add_peak(counter, data, rounds, lanes):
    """CHAINS independent chains of multiply-adds, enough to keep two units of four cycles' latency busy."""
    n = len(lanes)
    while True:
        if next_item(counter) >= 1:
            break
        f, g = load(data, 0, lanes), load(data, n, lanes)
        a, b, c, d = (
            load(data, 0, lanes),
            load(data, n, lanes),
            load(data, 2 * n, lanes),
            load(data, 3 * n, lanes),
        )
        e, h, i, j = a + f, b + f, c + f, d + f
        k, m, o, p = a + g, b + g, c + g, d + g
        for _ in range(rounds):
            a, b, c, d = fma(a, f, g), fma(b, f, g), fma(c, f, g), fma(d, f, g)
            e, h, i, j = fma(e, f, g), fma(h, f, g), fma(i, f, g), fma(j, f, g)
            k, m, o, p = fma(k, f, g), fma(m, f, g), fma(o, f, g), fma(p, f, g)
        store(data, 4 * n, a + b + c + d + e + h + i + j + k + m + o + p)
