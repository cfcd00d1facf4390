"""Vector registers as values inside compiled functions.

The compiler does not vectorise the blending loops by itself (measured: eight times slower), so a kernel works
on `Lanes` explicitly: `a * b + c` on sixteen (or eight) pixels at once. LLVM lowers them to whatever the host
has: AVX-512, AVX2, SSE2, NEON. Everything below is the dictionary between numba and LLVM's vector types; no
mathematics of splatting is here.

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

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_IR_ELEMENT = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}
_BYTES = {types.float32: 4, types.float64: 8}


class Lanes(types.Type):
    """`count` floats in a register."""

    def __init__(self, element: types.Float, count: int) -> None:
        self.element, self.count = element, count
        super().__init__(f"lanes({element}, {count})")

    @property
    def ir_type(self) -> ir.VectorType:
        return ir.VectorType(_IR_ELEMENT[self.element], self.count)


class Mask(types.Type):
    """`count` truth values in a register."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"mask({count})")


class Bank(types.Type):
    """A few `Lanes` on the stack: registers, when the indices are known to the compiler."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        super().__init__(f"bank({lanes})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Lanes) -> None:
        super().__init__(manager, kind, kind.ir_type)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Mask) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.count))


@register_model(Bank)
class _BankModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Bank) -> None:
        super().__init__(manager, kind, kind.lanes.ir_type.as_pointer())


# ---------------------------------------------------------------- arithmetic


def _common(args: tuple[types.Type, ...]) -> Lanes | None:
    """The lanes type of an operation between lanes and lanes, or lanes and a number."""
    kinds = [a for a in args if isinstance(a, Lanes)]
    if kinds and all(a == kinds[0] or isinstance(a, types.Float | types.Integer) for a in args):
        return kinds[0]
    return None


def _spread(context: Any, builder: Any, value: Any, kind: types.Type, lanes: Lanes) -> Any:
    """A number in every lane; lanes stay what they are."""
    if isinstance(kind, Lanes):
        return value
    number = context.cast(builder, value, kind, lanes.element)
    first = builder.insert_element(ir.Constant(lanes.ir_type, ir.Undefined), number, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, lanes.count), [0] * lanes.count)
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
        values = [_spread(context, builder, a, t, kind) for a, t in zip(args, sig.args, strict=True)]
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
    suffix = f"v{lanes.count}f{8 * _BYTES[lanes.element]}"
    kind = ir.FunctionType(lanes.ir_type, [lanes.ir_type] * len(values))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{suffix}")
    return builder.call(function, values)


def _elementwise(name: str, arguments: int) -> Any:
    """An intrinsic of lanes (numbers are spread) that is LLVM's `name`."""

    def code(sig: Any) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = sig.return_type
            values = [_spread(context, builder, a, t, kind) for a, t in zip(args, sig.args, strict=True)]
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
"""a * b + c, in one rounding where the host can."""
root = _elementwise("sqrt", 1)
magnitude = _elementwise("fabs", 1)
floor = _elementwise("floor", 1)


def _extreme(test: str) -> Any:
    """The smaller or larger of two; the second where one is not a number (one step for vector units)."""

    def typed(typingctx: Any, a: Any, b: Any) -> Any:
        kind = _common((a, b))

        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = sig.return_type
            left, right = (_spread(context, builder, x, t, kind) for x, t in zip(args, sig.args, strict=True))
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
        yes, no = (_spread(context, builder, args[i], sig.args[i], kind) for i in (1, 2))
        return builder.select(args[0], yes, no)

    return kind(mask, a, b), lower


@intrinsic
def bits(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane 0 in bit 0."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(sig.args[0].count)), _I64)

    return types.int64(mask), lower


@intrinsic
def total(typingctx: Any, a: Any) -> Any:
    """The sum over the lanes, in a fixed order."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, count = args[0], sig.args[0].count
        while count > 1:
            count //= 2
            halves = [
                builder.shuffle_vector(value, value, ir.Constant(ir.VectorType(_I32, count), list(chosen)))
                for chosen in (range(count), range(count, 2 * count))
            ]
            value = builder.fadd(*halves)
        return builder.extract_element(value, ir.Constant(_I32, 0))

    return a.element(a), lower


@intrinsic
def scale_by_low_bits(typingctx: Any, a: Any, n: Any) -> Any:
    """a times 2^k, k the integer that the low bits of the float n hold: added to the exponent bits of a."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        integers = ir.VectorType(_I32, sig.return_type.count)
        low = builder.shl(builder.bitcast(args[1], integers), ir.Constant(integers, [23] * integers.count))
        scaled = builder.add(builder.bitcast(args[0], integers), low)
        return builder.bitcast(scaled, sig.return_type.ir_type)

    return a(a, n), lower


@intrinsic
def split_exponent(typingctx: Any, a: Any) -> Any:
    """Positive normal double lanes a = m 2^n with m in [1, 2): (m, n) as double lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = sig.args[0]
        integers = ir.VectorType(_I64, kind.count)

        def constant(value: int) -> Any:
            return ir.Constant(integers, [value] * kind.count)

        raw = builder.bitcast(args[0], integers)
        mantissa = builder.or_(builder.and_(raw, constant((1 << 52) - 1)), constant(1023 << 52))
        exponent = builder.sub(builder.lshr(raw, constant(52)), constant(1023))
        pair = [builder.bitcast(mantissa, kind.ir_type), builder.sitofp(exponent, kind.ir_type)]
        return context.make_tuple(builder, sig.return_type, pair)

    return types.UniTuple(a, 2)(a), lower


# ---------------------------------------------------------------- memory


def _element_pointer(context: Any, builder: Any, kind: types.Array, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [index])


@intrinsic
def load(typingctx: Any, array: Any, index: Any, lanes: Any) -> Any:
    """As many consecutive numbers of a flat contiguous array as `lanes` is long."""
    kind = Lanes(array.dtype, len(lanes))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        place = builder.bitcast(place, kind.ir_type.as_pointer())
        return builder.load(place, align=_BYTES[kind.element], typ=kind.ir_type)

    return kind(array, types.intp, lanes), lower


@intrinsic
def bit_column(typingctx: Any, array: Any, index: Any, bit: Any, lanes: Any) -> Any:
    """Which of the int32 from array[index] on have a bit of `bit` set: an integer, the first in bit 0."""
    count = len(lanes)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        integers = ir.VectorType(_I32, count)
        place = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        words = builder.load(builder.bitcast(place, integers.as_pointer()), align=4, typ=integers)
        number = builder.trunc(args[2], _I32)
        first = builder.insert_element(ir.Constant(integers, ir.Undefined), number, ir.Constant(_I32, 0))
        wanted = builder.shuffle_vector(first, first, ir.Constant(integers, [0] * count))
        hit = builder.icmp_unsigned("!=", builder.and_(words, wanted), ir.Constant(integers, [0] * count))
        return builder.zext(builder.bitcast(hit, ir.IntType(count)), _I64)

    return types.int64(array, types.intp, types.int64, lanes), lower


@intrinsic
def set_at(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index] = value of a flat contiguous array, index known to be inside."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _element_pointer(context, builder, sig.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, types.intp, array.dtype), lower


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write lanes to consecutive places of a flat contiguous array."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        kind = sig.args[2]
        builder.store(args[2], builder.bitcast(place, kind.ir_type.as_pointer()), align=_BYTES[kind.element])
        return context.get_dummy_value()

    return types.void(array, types.intp, value), lower


@intrinsic
def at(typingctx: Any, array: Any, index: Any) -> Any:
    """array[index] of a flat contiguous array, index known to be inside (no wrap-around for negatives)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_element_pointer(context, builder, sig.args[0], args[0], args[1]))

    return array.dtype(array, types.intp), lower


def _prefetch(array: Any, to_write: int) -> Any:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        bytes_pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [bytes_pointer, _I32, _I32, _I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        options = [ir.Constant(_I32, value) for value in (to_write, 3, 1)]
        builder.call(function, [builder.bitcast(place, bytes_pointer), *options])
        return context.get_dummy_value()

    return types.void(array, types.intp), lower


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of array[index], to read it."""
    return _prefetch(array, 0)


@intrinsic
def prefetch_to_write(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of array[index], to write it."""
    return _prefetch(array, 1)


@intrinsic
def spread(typingctx: Any, value: Any, lanes: Any) -> Any:
    """A float in every lane."""
    kind = Lanes(value, len(lanes))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _spread(context, builder, args[0], sig.args[0], kind)

    return kind(value, lanes), lower


@intrinsic
def take(typingctx: Any, counter: Any) -> Any:
    """Atomically count up an int64 array's first element; returns the value before."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _element_pointer(context, builder, sig.args[0], args[0], ir.Constant(_I64, 0))
        return builder.atomic_rmw("add", place, ir.Constant(_I64, 1), "monotonic")

    return types.int64(counter), lower


@intrinsic
def lowest_bit(typingctx: Any, value: Any) -> Any:
    """Index of the lowest set bit of a number that is not zero."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), lower


# ---------------------------------------------------------------- banks of registers


@intrinsic
def bank(typingctx: Any, size: Any, scratch: Any, lanes: Any) -> Any:
    """Room for lanes: on the stack when `size` is a tuple (its length known), else in the array `scratch`."""
    kind = Bank(Lanes(scratch.dtype, len(lanes)))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if isinstance(sig.args[0], types.BaseTuple):
            count = ir.Constant(_I32, len(sig.args[0]))
            return cgutils.alloca_once(builder, kind.lanes.ir_type, size=count)
        start = _element_pointer(context, builder, sig.args[1], args[1], ir.Constant(_I64, 0))
        return builder.bitcast(start, kind.lanes.ir_type.as_pointer())

    return kind(size, scratch, lanes), lower


@intrinsic
def bank_at(typingctx: Any, array: Any, index: Any, lanes: Any) -> Any:
    """The numbers of a flat contiguous array from `index` on, as a bank."""
    kind = Bank(Lanes(array.dtype, len(lanes)))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        return builder.bitcast(start, kind.lanes.ir_type.as_pointer())

    return kind(array, types.intp, lanes), lower


@intrinsic
def put(typingctx: Any, place: Any, index: Any, value: Any) -> Any:
    """bank[index] = value."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], builder.gep(args[0], [args[1]]), align=4)
        return context.get_dummy_value()

    return types.void(place, types.intp, value), lower


@intrinsic
def get(typingctx: Any, place: Any, index: Any) -> Any:
    """bank[index]."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(builder.gep(args[0], [args[1]]), align=4, typ=sig.return_type.ir_type)

    return place.lanes(place, types.intp), lower


@intrinsic
def lane_sums(typingctx: Any, place: Any, first: Any) -> Any:
    """Sums over the lanes of `count` entries of a bank from `first` on: entry k ends up in lane k.

    A butterfly: at each level pairs of registers are merged into one, so that L registers cost L - 1 merges.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = sig.return_type
        count = kind.count
        values = []
        for k in range(count):
            index = builder.add(args[1], ir.Constant(_I64, k))
            values.append(builder.load(builder.gep(args[0], [index]), align=4, typ=kind.ir_type))
        step = 1
        while len(values) > 1:
            keep = [lane if not lane & step else lane + count for lane in range(count)]
            swap = [lane ^ step if not lane & step else (lane ^ step) + count for lane in range(count)]
            masks = [ir.Constant(ir.VectorType(_I32, count), chosen) for chosen in (keep, swap)]
            values = [
                builder.fadd(*(builder.shuffle_vector(a, b, mask) for mask in masks))
                for a, b in zip(values[::2], values[1::2], strict=True)
            ]
            step *= 2
        return values[0]

    return place.lanes(place, types.int64), lower


@intrinsic
def length(typingctx: Any, size: Any) -> Any:
    """How many: the length of a tuple (then known to the compiler), or the number itself."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if isinstance(sig.args[0], types.BaseTuple):
            return ir.Constant(_I64, len(sig.args[0]))
        return args[0]

    return types.int64(size), lower
