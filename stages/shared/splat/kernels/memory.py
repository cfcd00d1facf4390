"""Vector registers and memory: loads, stores, prefetches, the shared counter, and register tiles.

Like `simd.py`, this maps numba functions to LLVM instructions. Arrays are flat and contiguous. Indices are
not checked.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from stages.shared.splat.kernels.simd import BYTES, I32, I64, Lanes, broadcast_lanes


class RegisterTile(types.Type):
    """Several `Lanes` on the stack; they become registers when the compiler knows the indices."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        super().__init__(f"register_tile({lanes})")


@register_model(RegisterTile)
class _RegisterTileModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: RegisterTile) -> None:
        super().__init__(manager, kind, kind.lanes.ir_type.as_pointer())


def _element_pointer(context: Any, builder: Any, kind: types.Array, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [index])


@intrinsic
def load(typingctx: Any, array: Any, index: Any, lanes: Any) -> Any:
    """len(lanes) consecutive numbers of a flat contiguous array."""
    kind = Lanes(array.dtype, len(lanes))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        place = builder.bitcast(place, kind.ir_type.as_pointer())
        return builder.load(place, align=BYTES[kind.element], typ=kind.ir_type)

    return kind(array, types.intp, lanes), lower


@intrinsic
def bit_column(typingctx: Any, array: Any, index: Any, bit: Any, lanes: Any) -> Any:
    """Which of the int32 from array[index] on have a bit of `bit` set: an integer, the first in bit 0."""
    count = len(lanes)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        integers = ir.VectorType(I32, count)
        place = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        words = builder.load(builder.bitcast(place, integers.as_pointer()), align=4, typ=integers)
        number = builder.trunc(args[2], I32)
        first = builder.insert_element(ir.Constant(integers, ir.Undefined), number, ir.Constant(I32, 0))
        wanted = builder.shuffle_vector(first, first, ir.Constant(integers, [0] * count))
        hit = builder.icmp_unsigned("!=", builder.and_(words, wanted), ir.Constant(integers, [0] * count))
        return builder.zext(builder.bitcast(hit, ir.IntType(count)), I64)

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
        builder.store(args[2], builder.bitcast(place, kind.ir_type.as_pointer()), align=BYTES[kind.element])
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
        kind = ir.FunctionType(ir.VoidType(), [bytes_pointer, I32, I32, I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        options = [ir.Constant(I32, value) for value in (to_write, 3, 1)]
        builder.call(function, [builder.bitcast(place, bytes_pointer), *options])
        return context.get_dummy_value()

    return types.void(array, types.intp), lower


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of array[index] for reading."""
    return _prefetch(array, 0)


@intrinsic
def prefetch_to_write(typingctx: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of array[index] for writing."""
    return _prefetch(array, 1)


@intrinsic
def broadcast(typingctx: Any, value: Any, lanes: Any) -> Any:
    """A float in every lane."""
    kind = Lanes(value, len(lanes))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return broadcast_lanes(context, builder, args[0], sig.args[0], kind)

    return kind(value, lanes), lower


@intrinsic
def next_item(typingctx: Any, counter: Any) -> Any:
    """Atomically increment the first element of an int64 array; returns the value before."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _element_pointer(context, builder, sig.args[0], args[0], ir.Constant(I64, 0))
        return builder.atomic_rmw("add", place, ir.Constant(I64, 1), "monotonic")

    return types.int64(counter), lower


@intrinsic
def lowest_bit(typingctx: Any, value: Any) -> Any:
    """Index of the lowest set bit of a number that is not zero."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), lower


@intrinsic
def register_tile(typingctx: Any, size: Any, scratch: Any, lanes: Any) -> Any:
    """Memory for lanes: on the stack if `size` is a tuple (length known), else in the array `scratch`."""
    kind = RegisterTile(Lanes(scratch.dtype, len(lanes)))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if isinstance(sig.args[0], types.BaseTuple):
            count = ir.Constant(I32, len(sig.args[0]))
            return cgutils.alloca_once(builder, kind.lanes.ir_type, size=count)
        start = _element_pointer(context, builder, sig.args[1], args[1], ir.Constant(I64, 0))
        return builder.bitcast(start, kind.lanes.ir_type.as_pointer())

    return kind(size, scratch, lanes), lower


@intrinsic
def register_tile_at(typingctx: Any, array: Any, index: Any, lanes: Any) -> Any:
    """The numbers of a flat contiguous array from `index` on, as a register tile."""
    kind = RegisterTile(Lanes(array.dtype, len(lanes)))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        return builder.bitcast(start, kind.lanes.ir_type.as_pointer())

    return kind(array, types.intp, lanes), lower


@intrinsic
def put(typingctx: Any, place: Any, index: Any, value: Any) -> Any:
    """tile[index] = value."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], builder.gep(args[0], [args[1]]), align=4)
        return context.get_dummy_value()

    return types.void(place, types.intp, value), lower


@intrinsic
def get(typingctx: Any, place: Any, index: Any) -> Any:
    """tile[index]."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(builder.gep(args[0], [args[1]]), align=4, typ=sig.return_type.ir_type)

    return place.lanes(place, types.intp), lower


@intrinsic
def lane_sums(typingctx: Any, place: Any, first: Any) -> Any:
    """Sums over the lanes of `count` entries of a register tile from `first` on: entry k ends up in lane k.

    A butterfly: at each level pairs of registers are merged into one, so that L registers cost L - 1 merges.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = sig.return_type
        count = kind.count
        values = []
        for k in range(count):
            index = builder.add(args[1], ir.Constant(I64, k))
            values.append(builder.load(builder.gep(args[0], [index]), align=4, typ=kind.ir_type))
        step = 1
        while len(values) > 1:
            keep = [lane if not lane & step else lane + count for lane in range(count)]
            swap = [lane ^ step if not lane & step else (lane ^ step) + count for lane in range(count)]
            masks = [ir.Constant(ir.VectorType(I32, count), chosen) for chosen in (keep, swap)]
            values = [
                builder.fadd(*(builder.shuffle_vector(a, b, mask) for mask in masks))
                for a, b in zip(values[::2], values[1::2], strict=True)
            ]
            step *= 2
        return values[0]

    return place.lanes(place, types.int64), lower


@intrinsic
def length(typingctx: Any, size: Any) -> Any:
    """The length of a tuple (known to the compiler), or the number itself."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if isinstance(sig.args[0], types.BaseTuple):
            return ir.Constant(I64, len(sig.args[0]))
        return args[0]

    return types.int64(size), lower
