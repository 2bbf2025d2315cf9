# SPDX-License-Identifier: GPL-3.0-or-later
"""SIMD for numba: LLVM vectors of 16 lanes as numba types, for all kernels of this package.

numba has no vector types, and LLVM does not vectorise loops such as the kernels' by itself. So this module defines
three numba types (16 float32, 16 int32, 16 bool), Python's operators on them, and the functions below. LLVM maps a
vector to one zmm register, two ymm, four xmm or four NEON ones: one source for every machine.

Kernels use them as plain arithmetic: `alpha = where(e >= 0.5, e * t, 0.0)`. Scalars are broadcast to all lanes.
Products and sums may fuse (one rounding instead of two) where the machine can; nothing else is reordered.
"""
from __future__ import annotations

import operator
import platform
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numba.np import arrayobj

from .compilation import inlined

LANES = 16


class Vector(types.Type):
    """The type of 16 values of one kind: "float32", "int32" or "bool"."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        super().__init__(name=f"{kind}x{LANES}")


FLOATS, INTS, MASKS = Vector("float32"), Vector("int32"), Vector("bool")
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_LLVM = {
    "float32": ir.VectorType(_FLOAT, LANES),
    "int32": ir.VectorType(_INT, LANES),
    "bool": ir.VectorType(ir.IntType(1), LANES),
}
_CONTRACT = ("contract",)
_PAUSE = "llvm.x86.sse2.pause" if platform.machine().lower() in ("x86_64", "amd64") else ""
"""Intrinsic that marks a spin-wait loop; "" where the processor has none."""


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector: Vector) -> None:
        super().__init__(manager, vector, _LLVM[vector.kind])


# --- operators -------------------------------------------------------------------------------------------


def _broadcast(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    """Copy a scalar to all lanes."""
    kind = ir.VectorType(scalar.type, LANES)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_INT, 0))
    zeros = ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), zeros)


def _as_vector(context: Any, builder: ir.IRBuilder, value: ir.Value, type_: types.Type, kind: str) -> ir.Value:
    """Convert a number of `type_` to a vector of this kind; return vectors unchanged."""
    if isinstance(type_, Vector):
        return value
    scalar = {"float32": types.float32, "int32": types.int32, "bool": types.boolean}[kind]
    value = context.cast(builder, value, type_, scalar)
    if kind == "bool":
        value = builder.trunc(value, ir.IntType(1)) if value.type.width > 1 else value
    return _broadcast(builder, value)


def _kind_of(args: Sequence[types.Type]) -> str | None:
    """Return the kind of the vectors among two arguments; None if there is no vector, if two have different kinds, or
    if the other argument is not a number."""
    kinds = {a.kind for a in args if isinstance(a, Vector)}
    others = [a for a in args if not isinstance(a, Vector)]
    if len(kinds) != 1 or not all(isinstance(a, (types.Number, types.Boolean)) for a in others):
        return None
    return kinds.pop()


def _define_operator(symbol: Callable[..., Any], kinds: dict[str, Callable[..., ir.Value]], result: str) -> None:
    """Define the operator `symbol` for two vectors, or a vector and a number.

    kinds: by the vectors' kind, a function that emits the instruction, of (builder, a, b); other kinds are not
    supported. result: kind of the result, "" for that of the arguments."""

    class Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
            kind = _kind_of(args) if len(args) == 2 else None
            if kind not in kinds:
                return None
            return signature(Vector(result or kind), *args)

    infer_global(symbol)(Typing)

    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        kind = _kind_of(sig.args)
        assert kind is not None
        a, b = (_as_vector(context, builder, v, t, kind) for v, t in zip(args, sig.args, strict=True))
        return kinds[kind](builder, a, b)

    for left, right in ((Vector, Vector), (Vector, types.Number), (types.Number, Vector)):
        lower_builtin(symbol, left, right)(lower)


def _emit(name: str) -> Callable[..., ir.Value]:
    return lambda builder, a, b: getattr(builder, name)(a, b)


def _emit_contracted(name: str) -> Callable[..., ir.Value]:
    return lambda builder, a, b: getattr(builder, name)(a, b, flags=_CONTRACT)


def _compare(sign: str) -> dict[str, Callable[..., ir.Value]]:
    return {
        "float32": lambda builder, a, b: builder.fcmp_ordered(sign, a, b),
        "int32": lambda builder, a, b: builder.icmp_signed(sign, a, b),
    }


for _symbol, _name in ((operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul")):
    _emitters = {"float32": _emit_contracted("f" + _name), "int32": _emit(_name)}
    _define_operator(_symbol, _emitters, "")
    _define_operator(getattr(operator, "i" + _name), _emitters, "")
_define_operator(operator.truediv, {"float32": _emit_contracted("fdiv")}, "")
_define_operator(operator.lshift, {"int32": _emit("shl")}, "")
_define_operator(operator.rshift, {"int32": _emit("ashr")}, "")
_define_operator(operator.and_, {"int32": _emit("and_"), "bool": _emit("and_")}, "")
_define_operator(operator.or_, {"int32": _emit("or_"), "bool": _emit("or_")}, "")
for _symbol, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _define_operator(_symbol, _compare(_sign), "bool")


@infer_global(operator.neg)
class _Negation(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
        return signature(FLOATS, FLOATS) if tuple(args) == (FLOATS,) else None


@lower_builtin(operator.neg, Vector)
def _negate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
    return builder.fneg(args[0])


# --- functions -------------------------------------------------------------------------------------------


def _call(builder: ir.IRBuilder, name: str, result: ir.Type, args: Sequence[ir.Value], **options: Any) -> ir.Value:
    """Call an LLVM intrinsic by its full name."""
    type_ = ir.FunctionType(result, [a.type for a in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, type_, name), args, **options)


def _address(context: Any, builder: ir.IRBuilder, type_: types.Array, array: ir.Value, index: ir.Value) -> ir.Value:
    """Return the address of the flat index of a C-contiguous array of `type_`."""
    data = context.make_array(type_)(context, builder, array).data
    return builder.gep(data, [index])


@intrinsic
def load(typing_context, array, index):  # noqa: ARG001
    """Load 16 values from a flat index of a contiguous float32 or int32 array on."""
    kind = FLOATS if array.dtype == types.float32 else INTS

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        address = _address(context, builder, sig.args[0], *args)
        return builder.load(builder.bitcast(address, _LLVM[kind.kind].as_pointer()), align=4)

    return kind(array, types.int64), emit


@intrinsic
def load_scalar(typing_context, array, index):  # noqa: ARG001
    """Load one value at a flat index >= 0 of a contiguous array (array[index] would test for negative indices)."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load(_address(context, builder, sig.args[0], *args))

    return array.dtype(array, types.int64), emit


@intrinsic
def float_array(typing_context, address, size):  # noqa: ARG001
    """Return the float32 array of `size` numbers at an address in memory, int64, which the caller keeps alive."""
    result = types.Array(types.float32, 1, "C")

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        array, item_size = context.make_array(result)(context, builder), ir.Constant(ir.IntType(64), 4)
        arrayobj.populate_array(
            array, builder.inttoptr(args[0], _FLOAT.as_pointer()), cgutils.pack_array(builder, [args[1]]),
            cgutils.pack_array(builder, [item_size]), item_size, None,
        )  # fmt: skip
        return array._getvalue()

    return result(types.int64, types.int64), emit


@intrinsic
def opaque(typing_context, number):  # noqa: ARG001
    """Optimisation barrier: return the int64 unchanged, but unknown to LLVM. LLVM then does not unroll a loop with such
    a step into several loops, each of which would end with a branch to predict."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        type_ = ir.FunctionType(args[0].type, [args[0].type])
        return builder.call(ir.InlineAsm(type_, "", "=r,0"), args)

    return types.int64(types.int64), emit


@intrinsic
def store(typing_context, array, index, value):  # noqa: ARG001
    """Store 16 values from a flat index of a contiguous array on."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        address = _address(context, builder, sig.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(address, args[2].type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.none(array, types.int64, value), emit


@intrinsic
def load_rows(typing_context, array, index, stride):  # noqa: ARG001
    """Load 16 vectors from a flat index on, each `stride` elements after the one before."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        rows = []
        for i in range(LANES):
            row_index = builder.add(args[1], builder.mul(args[2], ir.Constant(ir.IntType(64), i)))
            address = _address(context, builder, sig.args[0], args[0], row_index)
            rows.append(builder.load(builder.bitcast(address, _LLVM["float32"].as_pointer()), align=4))
        return _make_tuple(context, builder, rows)

    return types.UniTuple(FLOATS, LANES)(array, types.int64, types.int64), emit


@intrinsic
def store_rows(typing_context, array, index, stride, rows):  # noqa: ARG001
    """Store a tuple of vectors from a flat index on, each `stride` elements after the one before."""
    count = len(rows)

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        for i in range(count):
            row_index = builder.add(args[1], builder.mul(args[2], ir.Constant(ir.IntType(64), i)))
            address = _address(context, builder, sig.args[0], args[0], row_index)
            row = builder.extract_value(args[3], i)
            builder.store(row, builder.bitcast(address, row.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.none(array, types.int64, types.int64, rows), emit


@intrinsic
def stream_rows(typing_context, array, index, stride, rows):  # noqa: ARG001
    """Store a tuple of vectors from a flat index on, each `stride` elements after the one before, past the caches: for
    data that is not read soon. All addresses must be aligned to cache lines."""
    count = len(rows)

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        for i in range(count):
            row_index = builder.add(args[1], builder.mul(args[2], ir.Constant(ir.IntType(64), i)))
            address = _address(context, builder, sig.args[0], args[0], row_index)
            row = builder.extract_value(args[3], i)
            written = builder.store(row, builder.bitcast(address, row.type.as_pointer()), align=4 * LANES)
            written.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(_INT, 1)]))
        return context.get_dummy_value()

    return types.none(array, types.int64, types.int64, rows), emit


def _make_prefetch(write: bool, purpose: str) -> Any:
    """Return the intrinsic that prefetches a cache line for writing (`write`) or reading. purpose: for its
    docstring."""

    def prefetch(typing_context, array, index):  # noqa: ARG001
        def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
            address = _address(context, builder, sig.args[0], *args)
            address = builder.bitcast(address, ir.IntType(8).as_pointer())
            flags = [ir.Constant(_INT, flag) for flag in (int(write), 3, 1)]  # keep in all caches, data
            _call(builder, "llvm.prefetch.p0", ir.VoidType(), [address, *flags])
            return context.get_dummy_value()

        return types.none(array, types.int64), emit

    prefetch.__doc__ = f"Prefetch the cache line of a flat index, which is {purpose} soon; any index is safe."
    return intrinsic(prefetch)


prefetch = _make_prefetch(False, "read")
prefetch_to_write = _make_prefetch(True, "written (and so exclusive to this core)")


@intrinsic
def atomic_increment(typing_context, counter):  # noqa: ARG001
    """Atomically add one to the first element of an int64 array; return its value before."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        address = _address(context, builder, sig.args[0], args[0], ir.Constant(ir.IntType(64), 0))
        return builder.atomic_rmw("add", address, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), emit


@intrinsic
def atomic_add(typing_context, array, index, amount):  # noqa: ARG001
    """Atomically add an amount to an element of an int64 array, with acquire and release order; return its value
    before."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        address = _address(context, builder, sig.args[0], args[0], args[1])
        return builder.atomic_rmw("add", address, args[2], "acq_rel")

    return types.int64(array, types.int64, types.int64), emit


@intrinsic
def load_acquire(typing_context, array):  # noqa: ARG001
    """Load the first element of an int64 array, which another thread may change, with acquire order.

    The caller repeats this until the element changes; a pause instruction before the load spares the processor.
    """

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        if _PAUSE:
            _call(builder, _PAUSE, ir.VoidType(), [])
        address = _address(context, builder, sig.args[0], args[0], ir.Constant(ir.IntType(64), 0))
        return builder.load_atomic(address, "acquire", 8)

    return types.int64(array), emit


@intrinsic
def store_release(typing_context, array, number):  # noqa: ARG001
    """Store the first element of an int64 array with release order, for `load_acquire`."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        address = _address(context, builder, sig.args[0], args[0], ir.Constant(ir.IntType(64), 0))
        builder.store_atomic(args[1], address, "release", 8)
        return context.get_dummy_value()

    return types.none(array, types.int64), emit


@intrinsic
def splat(typing_context, value):  # noqa: ARG001
    """Return a number in all 16 lanes, as float32."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return _as_vector(context, builder, args[0], sig.args[0], "float32")

    return FLOATS(value), emit


@intrinsic
def lane_index(typing_context):  # noqa: ARG001
    """Return 0, 1, ... 15 as float32."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return ir.Constant(_LLVM["float32"], [float(i) for i in range(LANES)])

    return FLOATS(), emit


@intrinsic
def where(typing_context, mask, a, b):  # noqa: ARG001
    """Select a where the mask is true, else b; one of them may be a number."""
    kind = _kind_of((a, b))
    if mask != MASKS or kind is None:
        return None

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        a, b = (_as_vector(context, builder, v, t, kind) for v, t in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], a, b)

    return Vector(kind)(mask, a, b), emit


def _make_min_max(sign: str) -> Callable[..., Any]:
    """Return the definition of a function of a and b that returns a if the comparison a `sign` b is true, else b, also
    if either is NaN.

    LLVM makes one instruction of comparison and select, whereas llvm.minnum adds a test for NaN."""
    def define(typing_context, a, b):  # noqa: ARG001
        if _kind_of((a, b)) != "float32":
            return None

        def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
            a, b = (_as_vector(context, builder, v, t, "float32") for v, t in zip(args, sig.args, strict=True))
            return builder.select(builder.fcmp_ordered(sign, a, b), a, b)

        return FLOATS(a, b), emit

    return define


minimum = intrinsic(_make_min_max("<"))
maximum = intrinsic(_make_min_max(">"))


@intrinsic
def fma(typing_context, a, b, c):  # noqa: ARG001
    """Return a * b + c, rounded once where the machine can (llvm.fma would call a library where it cannot)."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        values = [_as_vector(context, builder, v, t, "float32") for v, t in zip(args, sig.args, strict=True)]
        return _call(builder, "llvm.fmuladd.v16f32", _LLVM["float32"], values)

    return FLOATS(a, b, c), emit


@intrinsic
def sqrt(typing_context, a):  # noqa: ARG001
    """Return square roots."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return _call(builder, "llvm.sqrt.v16f32", _LLVM["float32"], args)

    return FLOATS(FLOATS), emit


@intrinsic
def absolute(typing_context, a):  # noqa: ARG001
    """Return absolute values."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return _call(builder, "llvm.fabs.v16f32", _LLVM["float32"], args)

    return FLOATS(FLOATS), emit


@intrinsic
def any_of(typing_context, mask):  # noqa: ARG001
    """Return whether any lane is true."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(MASKS), emit


@intrinsic
def as_ints(typing_context, a):  # noqa: ARG001
    """Reinterpret the bits of float32 lanes as int32."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return builder.bitcast(args[0], _LLVM["int32"])

    return INTS(FLOATS), emit


@intrinsic
def as_floats(typing_context, a):  # noqa: ARG001
    """Reinterpret the bits of int32 lanes as float32."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return builder.bitcast(args[0], _LLVM["float32"])

    return FLOATS(INTS), emit


@intrinsic
def to_floats(typing_context, a):  # noqa: ARG001
    """Convert int32 to float32 of the same value."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return builder.sitofp(args[0], _LLVM["float32"])

    return FLOATS(INTS), emit


@intrinsic
def to_ints(typing_context, a):  # noqa: ARG001
    """Convert float32 to int32, rounded towards zero; values must lie within int32."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return builder.fptosi(args[0], _LLVM["int32"])

    return INTS(FLOATS), emit


# --- across lanes ----------------------------------------------------------------------------------------


def _shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value | None, source: Sequence[int]) -> ir.Value:
    """Return a vector whose lane i is lane source[i] of a, or of b counted from 16 on."""
    if b is None:
        b = ir.Constant(a.type, ir.Undefined)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(source)), list(source)))


def _make_tuple(context: Any, builder: ir.IRBuilder, values: Sequence[ir.Value]) -> ir.Value:
    return context.make_tuple(builder, types.UniTuple(FLOATS, len(values)), values)


def _interleave_halves(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, step: int) -> tuple[ir.Value, ir.Value]:
    """Return, for each group of 2 * step lanes, the lower halves of a and b side by side, and the upper halves."""
    count = a.type.count
    low = [(i & ~(2 * step - 1)) + (i & (step - 1)) + (count if i & step else 0) for i in range(count)]
    return _shuffle(builder, a, b, low), _shuffle(builder, a, b, [i + step for i in low])


def _reduce_eight(builder: ir.IRBuilder, vectors: Sequence[ir.Value]) -> ir.Value:
    """Return a vector of 8 lanes, of which lane i is the sum of all lanes of vectors[i], for up to 8 vectors.

    Works as a transposition by halves, which adds the two halves at each step; lanes without a vector are undefined."""
    low, high = range(LANES // 2), range(LANES // 2, LANES)
    partial_sums: list[ir.Value | None] = [
        builder.fadd(_shuffle(builder, v, None, low), _shuffle(builder, v, None, high)) for v in vectors
    ]
    partial_sums += [None] * (LANES // 2 - len(partial_sums))
    for step in (4, 2, 1):
        num_pairs = len(partial_sums) // 2
        next_sums: list[ir.Value | None] = []
        for a, b in zip(partial_sums[:num_pairs], partial_sums[num_pairs:], strict=True):
            if a is not None:
                other = ir.Constant(a.type, ir.Undefined) if b is None else b
                a = builder.fadd(*_interleave_halves(builder, a, other, step))
            next_sums.append(a)
        partial_sums = next_sums
    return partial_sums[0]


@intrinsic
def reduce_add(typing_context, a):  # noqa: ARG001
    """Return the sum of all lanes, float32; in the same order on every machine."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        partial_sum = args[0]
        for step in (8, 4, 2, 1):
            partial_sum = builder.fadd(
                partial_sum, _shuffle(builder, partial_sum, None, [(i + step) % LANES for i in range(LANES)])
            )
        return builder.extract_element(partial_sum, ir.Constant(_INT, 0))

    return types.float32(FLOATS), emit


@intrinsic
def reduce_add_each(typing_context, vectors):  # noqa: ARG001
    """Return a vector whose lane i is the sum of all lanes of vectors[i], for up to 16; further lanes are undefined."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        values = [builder.extract_value(args[0], i) for i in range(len(vectors))]
        low = _reduce_eight(builder, values[:8])
        high = _reduce_eight(builder, values[8:]) if len(values) > 8 else ir.Constant(low.type, ir.Undefined)
        return _shuffle(builder, low, high, range(LANES))

    return FLOATS(vectors), emit


@intrinsic(prefer_literal=True)
def align_lanes(typing_context, a, b, count):  # noqa: ARG001
    """Return the lanes of a from `count` on, a constant within 0 .. 16, followed by the first lanes of b."""
    if not isinstance(count, types.IntegerLiteral):
        return None

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        first = count.literal_value
        return _shuffle(builder, args[0], args[1], range(first, first + LANES))

    return FLOATS(FLOATS, FLOATS, count), emit


@intrinsic
def multiply_each(typing_context, a, b):  # noqa: ARG001
    """Multiply two tuples of the same number of vectors, element by element."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        pairs = [[builder.extract_value(operand, i) for operand in args] for i in range(len(a))]
        return _make_tuple(context, builder, [builder.fmul(*pair, flags=_CONTRACT) for pair in pairs])

    return types.UniTuple(FLOATS, len(a))(a, b), emit


@intrinsic
def transpose(typing_context, vectors):  # noqa: ARG001
    """Transpose 16 vectors: lane j of result i is lane i of argument j. Blocks of 1, 2, 4, 8 lanes are exchanged."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        rows = [builder.extract_value(args[0], i) for i in range(LANES)]
        for step in (1, 2, 4, 8):
            for i in range(LANES):
                if not i & step:
                    rows[i], rows[i + step] = _interleave_halves(builder, rows[i], rows[i + step], step)
        return _make_tuple(context, builder, rows)

    return types.UniTuple(FLOATS, LANES)(vectors), emit


def _interleave_lanes(context: Any, builder: ir.IRBuilder, vectors: ir.Value, count: int, *, invert: bool) -> ir.Value:
    """Interleave the lanes of `count` vectors a, b, ... to a0 b0 ... a1 b1 ..., or with `invert` do the opposite."""
    inputs = [builder.extract_value(vectors, i) for i in range(count)]
    results = []
    for output in range(count):
        if invert:
            positions = [divmod(i * count + output, LANES) for i in range(LANES)]  # (vector, lane) of each result lane
        else:
            positions = [divmod(output * LANES + i, count)[::-1] for i in range(LANES)]
        # Step k puts the lanes that come from vector k into their places; step 1 those of vector 0 too.
        result = inputs[0]
        for vector_number in range(1, count):
            kept_lanes = [lane for _, lane in positions] if vector_number == 1 else range(LANES)
            source_lanes = [LANES + lane if vector == vector_number else kept
                            for (vector, lane), kept in zip(positions, kept_lanes, strict=True)]
            result = _shuffle(builder, result, inputs[vector_number], source_lanes)
        results.append(result)
    return _make_tuple(context, builder, results)


@intrinsic
def interleave(typing_context, vectors):  # noqa: ARG001
    """Interleave k vectors a, b, c ...: k vectors that hold a0 b0 c0 a1 b1 c1 ... in sequence."""
    count = len(vectors)

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return _interleave_lanes(context, builder, args[0], count, invert=False)

    return types.UniTuple(FLOATS, count)(vectors), emit


@intrinsic
def deinterleave(typing_context, vectors):  # noqa: ARG001
    """Invert `interleave`."""
    count = len(vectors)

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:  # noqa: ARG001
        return _interleave_lanes(context, builder, args[0], count, invert=True)

    return types.UniTuple(FLOATS, count)(vectors), emit


# --- 16 rows of arrays, flat ------------------------------------------------------------------------------


@inlined
def load3(array, first):
    """Return the three columns of 16 rows of an array (n, 3), from row `first` on."""
    at = 3 * first
    return deinterleave((load(array, at), load(array, at + LANES), load(array, at + 2 * LANES)))


@inlined
def load4(array, first):
    """Return the four columns of 16 rows of an array (n, 4), from row `first` on."""
    at = 4 * first
    return deinterleave((
        load(array, at), load(array, at + LANES), load(array, at + 2 * LANES), load(array, at + 3 * LANES),
    ))  # fmt: skip


@inlined
def store2(array, first, columns):
    """Write the two columns of 16 rows of an array (n, 2), from row `first` on."""
    store_rows(array, 2 * first, LANES, interleave(columns))


@inlined
def store3(array, first, columns):
    """Write the three columns of 16 rows of an array (n, 3), from row `first` on."""
    store_rows(array, 3 * first, LANES, interleave(columns))


@inlined
def store4(array, first, columns):
    """Write the four columns of 16 rows of an array (n, 4), from row `first` on."""
    store_rows(array, 4 * first, LANES, interleave(columns))


# --- elementary functions --------------------------------------------------------------------------------

# 2^f on [-1/2, 1/2]: the minimax polynomial in relative error that is exact at 0 (8e-8).
_EXP2 = tuple(
    np.float32(c) for c in (1.0, 0.6931470616, 0.2402223532, 0.05550678369, 0.00967196168, 0.001327463337)
)
_ROUND = np.float32(1.5 * 2**23)  # added, it leaves the nearest integer in the lowest bits
_EXP2_MIN = np.float32(-126.0)
_EXP2_MAX = np.float32(126.5)


@inlined
def exp2_unclamped(x):
    """Return 2^x for x within -126 .. 126; undefined outside.

    x is split into the nearest integer and a remainder f; 2^f is a polynomial of degree 5."""
    rounded = x + _ROUND
    f = x - (rounded - _ROUND)
    ff = f * f
    p = fma(ff, fma(f, _EXP2[5], _EXP2[4]), fma(f, _EXP2[3], _EXP2[2]))
    p = fma(ff, p, fma(f, _EXP2[1], _EXP2[0]))
    return as_floats(as_ints(p) + (as_ints(rounded) << 23))  # adds the integer part to the bits of the exponent


@inlined
def exp2(x):
    """Return 2^x with x clamped to -126 .. 126.5: never below 1e-38, and not zero."""
    return exp2_unclamped(minimum(maximum(x, _EXP2_MIN), _EXP2_MAX))


_LOG2_E = np.float32(1.4426950408889634)
_FLOAT_MAX, _INFINITY = np.float32(3.4028235e38), np.float32(np.inf)


@inlined
def exp(x):
    """Return e^x, 1.2e-6 relative within -20 .. 20 (half an ulp of x / ln 2); NaN and +infinity stay."""
    return where(x <= _FLOAT_MAX, exp2(x * _LOG2_E), x)


@inlined
def sigmoid(x):
    """Return 1 / (1 + e^-x); NaN stays."""
    return where(x <= _INFINITY, np.float32(1) / (exp2(x * -_LOG2_E) + np.float32(1)), x)


# (2^f - 1) / f on [-1/2, 1/2].
_EXP2M1 = tuple(
    np.float32(c) for c in (0.6931471807, 0.2402265068, 0.05550358232, 0.009618535704, 0.001339278274, 0.0001527416535)
)


@inlined
def exp2m1(x):
    """Return 2^x - 1, as accurate relatively near 0 as elsewhere: there by f times a polynomial, without a subtraction.
    """
    f = minimum(maximum(x, np.float32(-0.5)), np.float32(0.5))
    p = fma(f, _EXP2M1[5], _EXP2M1[4])
    p = fma(f, p, _EXP2M1[3])
    p = fma(f, p, _EXP2M1[2])
    p = fma(f, p, _EXP2M1[1])
    p = fma(f, p, _EXP2M1[0])
    return where(absolute(x) <= np.float32(0.5), f * p, exp2(x) - np.float32(1))


_SQRT2 = np.float32(1.4142135)
# 2 / ln 2 times the series of the inverse hyperbolic tangent
_LOG2 = tuple(np.float32(2.8853900817779268 / k) for k in (1, 3, 5, 7, 9))


@inlined
def log2(x):
    """Return log2 x for normal x > 0 (2e-7 absolute near 1): the exponent plus log2 of the mantissa m, by the series in
    s = (m - 1) / (m + 1), with m brought to sqrt(1/2) .. sqrt(2)."""
    bits = as_ints(x)
    exponent = to_floats(((bits >> 23) & 255) - 127)
    m = as_floats((bits & 0x007FFFFF) | 0x3F800000)
    large = m > _SQRT2
    m = where(large, m * np.float32(0.5), m)
    exponent = where(large, exponent + np.float32(1), exponent)
    s = (m - np.float32(1)) / (m + np.float32(1))
    s2 = s * s
    p = fma(s2, _LOG2[4], _LOG2[3])
    p = fma(s2, p, _LOG2[2])
    p = fma(s2, p, _LOG2[1])
    p = fma(s2, p, _LOG2[0])
    return fma(s, p, exponent)
