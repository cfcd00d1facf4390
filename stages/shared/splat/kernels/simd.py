"""Vector registers as values inside compiled functions.

The compiler does not vectorise the blending loops by itself (measured: eight times slower). A kernel
therefore works on `Lanes` explicitly: `a * b + c` on sixteen (or eight) pixels at once. LLVM lowers them to
the vector instructions of the host: AVX-512, AVX2, SSE2 or NEON. This module only maps numba types and
operators to LLVM's vector types; it contains no mathematics of splatting.

How many lanes: kernels take an argument `lanes`, a tuple whose length is the count (see `lanes_argument`), so
that the count is part of the compiled signature. `channels` works the same way.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

I32, I64 = ir.IntType(32), ir.IntType(64)
_IR_ELEMENT = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}
BYTES = {types.float32: 4, types.float64: 8}


class Lanes(types.Type):
    """`count` floats in a vector register."""

    def __init__(self, element: types.Float, count: int) -> None:
        self.element, self.count = element, count
        super().__init__(f"lanes({element}, {count})")

    @property
    def ir_type(self) -> ir.VectorType:
        return ir.VectorType(_IR_ELEMENT[self.element], self.count)


class Mask(types.Type):
    """`count` booleans in a vector register."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"mask({count})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Lanes) -> None:
        super().__init__(manager, kind, kind.ir_type)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Mask) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.count))


def _common(args: tuple[types.Type, ...]) -> Lanes | None:
    """The lanes type of an operation between lanes and lanes, or lanes and a number."""
    kinds = [a for a in args if isinstance(a, Lanes)]
    if kinds and all(a == kinds[0] or isinstance(a, types.Float | types.Integer) for a in args):
        return kinds[0]
    return None


def broadcast_lanes(context: Any, builder: Any, value: Any, kind: types.Type, lanes: Lanes) -> Any:
    """A number copied to every lane; lanes are returned unchanged."""
    if isinstance(kind, Lanes):
        return value
    number = context.cast(builder, value, kind, lanes.element)
    first = builder.insert_element(ir.Constant(lanes.ir_type, ir.Undefined), number, ir.Constant(I32, 0))
    zeros = ir.Constant(ir.VectorType(I32, lanes.count), [0] * lanes.count)
    return builder.shuffle_vector(first, first, zeros)


class _Arithmetic(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        kind = _common(args)
        return signature(kind, *args) if kind else None


class _Comparison(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        kind = _common(args)
        return signature(Mask(kind.count), *args) if kind else None


class _MaskAnd(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return (
            signature(args[0], *args)
            if len(args) == 2 and args[0] == args[1] and isinstance(args[0], Mask)
            else None
        )


def _binary(build: str, **options: Any) -> Any:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = _common(sig.args)
        assert kind is not None
        values = [broadcast_lanes(context, builder, a, t, kind) for a, t in zip(args, sig.args, strict=True)]
        # Doubles (projection) may be contracted to fused multiply-adds; floats (blending) are fused
        # explicitly, so that the forward and backward passes take the same decisions bit for bit.
        flags = {"flags": ("contract",)} if kind.element == types.float64 and build != "fcmp_ordered" else {}
        if build == "fcmp_ordered":
            return builder.fcmp_ordered(options["test"], *values)
        return getattr(builder, build)(*values, **flags)

    return lower


for _operator, _build in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    infer_global(_operator)(type("_Arithmetic", (_Arithmetic,), {}))
    for _left, _right in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(_operator, _left, _right)(_binary(_build))

for _operator, _test in ((operator.ge, ">="), (operator.gt, ">"), (operator.lt, "<"), (operator.le, "<=")):
    infer_global(_operator)(type("_Comparison", (_Comparison,), {}))
    for _left, _right in ((Lanes, Lanes), (Lanes, types.Number)):
        lower_builtin(_operator, _left, _right)(_binary("fcmp_ordered", test=_test))

infer_global(operator.and_)(_MaskAnd)


@lower_builtin(operator.and_, Mask, Mask)
def _lower_mask_and(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.and_(*args)


def _call(builder: Any, name: str, lanes: Lanes, values: list[Any]) -> Any:
    """Call LLVM's intrinsic `name` of this vector type."""
    suffix = f"v{lanes.count}f{8 * BYTES[lanes.element]}"
    kind = ir.FunctionType(lanes.ir_type, [lanes.ir_type] * len(values))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{suffix}")
    return builder.call(function, values)


def _elementwise(name: str, arguments: int) -> Any:
    """LLVM's intrinsic `name` on lanes; numbers are broadcast."""

    def code(sig: Any) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = sig.return_type
            values = [
                broadcast_lanes(context, builder, a, t, kind) for a, t in zip(args, sig.args, strict=True)
            ]
            return _call(builder, name, kind, values)

        return lower

    if arguments == 1:

        def unary(typingctx: Any, a: Any) -> Any:
            kind = _common((a,))
            return (kind(a), code(None)) if kind else None

        return intrinsic(unary)
    if arguments == 2:

        def binary(typingctx: Any, a: Any, b: Any) -> Any:
            kind = _common((a, b))
            return (kind(a, b), code(None)) if kind else None

        return intrinsic(binary)

    def ternary(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
        kind = _common((a, b, c))
        return (kind(a, b, c), code(None)) if kind else None

    return intrinsic(ternary)


fma = _elementwise("fmuladd", 3)
"""a * b + c, with one rounding where the host supports it."""
root = _elementwise("sqrt", 1)
magnitude = _elementwise("fabs", 1)
floor = _elementwise("floor", 1)


def _extreme(test: str) -> Any:
    """The smaller or larger of two; the second where one is not a number (one step for vector units)."""

    def typed(typingctx: Any, a: Any, b: Any) -> Any:
        kind = _common((a, b))

        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = sig.return_type
            left, right = (
                broadcast_lanes(context, builder, x, t, kind) for x, t in zip(args, sig.args, strict=True)
            )
            return builder.select(builder.fcmp_ordered(test, left, right), left, right)

        return (kind(a, b), lower) if kind else None

    return intrinsic(typed)


minimum = _extreme("<")
maximum = _extreme(">")


@intrinsic
def to_single(typingctx: Any, a: Any) -> Any:
    """Double lanes rounded to what float32 can hold, still as doubles."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = sig.return_type
        singles = ir.VectorType(ir.FloatType(), kind.count)
        return builder.fpext(builder.fptrunc(args[0], singles), kind.ir_type)

    return a(a), lower


@intrinsic
def negative(typingctx: Any, a: Any) -> Any:
    """-a, which the compiler folds into a fused multiply-add where it can."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.fneg(args[0])

    return a(a), lower


@intrinsic
def where(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask holds, else b."""
    kind = _common((a, b))
    if not isinstance(mask, Mask) or kind is None:
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = sig.return_type
        yes, no = (broadcast_lanes(context, builder, args[i], sig.args[i], kind) for i in (1, 2))
        return builder.select(args[0], yes, no)

    return kind(mask, a, b), lower


@intrinsic
def bits(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane 0 in bit 0."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(sig.args[0].count)), I64)

    return types.int64(mask), lower


@intrinsic
def total(typingctx: Any, a: Any) -> Any:
    """The sum over the lanes, in a fixed order."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, count = args[0], sig.args[0].count
        while count > 1:
            count //= 2
            halves = [
                builder.shuffle_vector(value, value, ir.Constant(ir.VectorType(I32, count), list(chosen)))
                for chosen in (range(count), range(count, 2 * count))
            ]
            value = builder.fadd(*halves)
        return builder.extract_element(value, ir.Constant(I32, 0))

    return a.element(a), lower


@intrinsic
def scale_by_low_bits(typingctx: Any, a: Any, n: Any) -> Any:
    """a times 2^k, k the integer that the low bits of n hold: added to the exponent bits of a."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        word, mantissa = (I32, 23) if sig.return_type.element == types.float32 else (I64, 52)
        integers = ir.VectorType(word, sig.return_type.count)
        place = ir.Constant(integers, [mantissa] * integers.count)
        low = builder.shl(builder.bitcast(args[1], integers), place)
        scaled = builder.add(builder.bitcast(args[0], integers), low)
        return builder.bitcast(scaled, sig.return_type.ir_type)

    return a(a, n), lower


@intrinsic
def split_exponent(typingctx: Any, a: Any) -> Any:
    """Positive normal double lanes a = m 2^n with m in [1, 2): (m, n) as double lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = sig.args[0]
        integers = ir.VectorType(I64, kind.count)

        def constant(value: int) -> Any:
            return ir.Constant(integers, [value] * kind.count)

        raw = builder.bitcast(args[0], integers)
        mantissa = builder.or_(builder.and_(raw, constant((1 << 52) - 1)), constant(1023 << 52))
        exponent = builder.sub(builder.lshr(raw, constant(52)), constant(1023))
        pair = [builder.bitcast(mantissa, kind.ir_type), builder.sitofp(exponent, kind.ir_type)]
        return context.make_tuple(builder, sig.return_type, pair)

    return types.UniTuple(a, 2)(a), lower
