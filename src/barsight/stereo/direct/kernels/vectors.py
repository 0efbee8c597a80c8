"""Write vector instructions into compiled kernels for loops that the compiler vectorises badly.

These loops run over a few dozen candidates, or a few columns whose sums should stay in registers: automatic
vectorisation adds checks for overlapping arrays and a remainder loop, which cost more than the work itself.
The code built here is LLVM's portable vector code, which it compiles for each processor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 32
HALF_LANES = LANES // 2
BYTE, SHORT, FLOAT = ir.IntType(8), ir.IntType(16), ir.FloatType()
FLOAT_LANES = 16
_LINE_BYTES = 64


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def stack_array(_: Any, count: Any, kind: Any) -> Any:
    """Allocate an array of `count` numbers, a constant, on the stack of the kernel that calls this; it begins
    with no values and must not outlive the kernel. kind: such as np.float32.

    The compiler knows that no argument overlaps with it: a loop that adds to it needs no check for that, and
    its sums can stay in registers.
    """
    numbers, signature = int(count.literal_value), types.Array(kind.dtype, 1, "C")(count, kind)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        own, index = context.get_data_type(kind.dtype), context.get_value_type(types.intp)
        room = cgutils.alloca_once(builder, ir.ArrayType(own, numbers))
        room.align = _LINE_BYTES
        array, side = context.make_array(signature.return_type)(context, builder), kind.dtype.bitwidth // 8
        context.populate_array(
            array, data=builder.bitcast(room, ir.PointerType(own)), shape=[index(numbers)],
            strides=[index(side)], itemsize=index(side), meminfo=None,
        )  # fmt: skip
        return array._getvalue()

    return signature, generate


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(_: Any, array: Any, at: Any) -> Any:
    """Ask the processor to bring element `at` of a flat array, or a place beside the array, into its nearest
    cache. It changes nothing else.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        place = builder.bitcast(builder.gep(v.data(0), [arguments[1]]), ir.PointerType(BYTE))
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [place.type, number, number, number])
        call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(call, [place, number(0), number(3), number(1)])  # to read, keep near, data
        return context.get_dummy_value()

    return types.void(array, at), generate


def bytes_of(lanes: int) -> Any:
    """Return the type of a vector of `lanes` bytes."""
    return ir.VectorType(BYTE, lanes)


def shorts_of(lanes: int) -> Any:
    """Return the type of a vector of `lanes` 16-bit integers."""
    return ir.VectorType(SHORT, lanes)


class Vectors:
    """Writes vector instructions into one kernel; its arguments are the kernel's values as Numba passes
    them.
    """

    def __init__(
        self, context: Any, builder: Any, signature: Any, arguments: Any, float_lanes: int = FLOAT_LANES
    ) -> None:
        self.floats = ir.VectorType(ir.FloatType(), float_lanes)
        self._context, self.builder, self._kinds, self._arguments = (
            context,
            builder,
            signature.args,
            arguments,
        )

    def data(self, place: int) -> Any:
        """Return a pointer to the first element of the array that is argument number `place`."""
        array = self._context.make_array(self._kinds[place])
        return array(self._context, self.builder, self._arguments[place]).data

    def members(self, place: int) -> list[Any]:
        """Return the members of the tuple that is argument number `place`."""
        return list(cgutils.unpack_tuple(self.builder, self._arguments[place]))

    def by_chunks(self, count: Any, body: Callable[[Any, int], None]) -> None:
        """Write the loop over `count` bytes, a multiple of HALF_LANES: body(offset, lanes) for each vector
        of LANES, and for the half vector that may remain.
        """
        chunks = self.builder.udiv(count, count.type(LANES))
        with cgutils.for_range(self.builder, chunks) as loop:
            body(self.builder.mul(loop.index, loop.index.type(LANES)), LANES)
        whole = self.builder.mul(chunks, count.type(LANES))
        with self.builder.if_then(self.builder.icmp_unsigned("<", whole, count)):
            body(whole, HALF_LANES)

    def number(self, place: int, at: Any, kind: Any) -> Any:
        """Return a vector filled with one element of the array that is argument number `place`."""
        return self.all(self.builder.load(self.builder.gep(self.data(place), [at])), kind)

    def load(self, data: Any, at: Any, kind: Any) -> Any:
        """Load a vector that begins with element `at`."""
        return self.builder.load(self._pointer(data, at, kind), align=1)

    def store(self, vector: Any, data: Any, at: Any) -> None:
        """Store a vector from element `at` on."""
        self.builder.store(vector, self._pointer(data, at, vector.type), align=1)

    def _pointer(self, data: Any, at: Any, kind: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(data, [at]), ir.PointerType(kind))

    def all(self, value: Any, kind: Any) -> Any:
        """Return a vector filled with a value or a number."""
        if isinstance(value, int | float):
            return ir.Constant(kind, [value] * kind.count)
        first = self.builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
        return self.builder.shuffle_vector(
            first, first, ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
        )

    def min_each(self, one: Any, other: Any) -> Any:
        """Return the elementwise minimum of two unsigned vectors."""
        return self.builder.select(self.builder.icmp_unsigned("<", one, other), one, other)

    def apart(self, one: Any, other: Any) -> Any:
        """Return the absolute difference of unsigned integers."""
        forth, back = self.builder.sub(one, other), self.builder.sub(other, one)
        return self.builder.select(self.builder.icmp_unsigned("<", one, other), back, forth)

    def product(self, one: Any, *others: Any) -> Any:
        """Multiply vectors of floats."""
        for other in others:
            one = self.builder.fmul(one, other)
        return one

    def sum(self, one: Any, other: Any) -> Any:
        """Add vectors of floats."""
        return self.builder.fadd(one, other)

    def bound_below(self, vector: Any, floor: float) -> Any:
        """Return the elementwise maximum of a vector of floats and `floor`."""
        bounds = self.all(floor, self.floats)
        return self.builder.select(self.builder.fcmp_ordered(">", vector, bounds), vector, bounds)

    def sum_of(self, vector: Any) -> Any:
        """Return the sum of a vector's floats, added in halves so that it is the same on every processor."""
        return self._halved(vector, self.sum)

    def extreme_of(self, vector: Any, which: str) -> Any:
        """Return the "min" or "max" of a vector's floats."""
        sign = {"min": "<", "max": ">"}[which]
        return self._halved(
            vector,
            lambda one, other: self.builder.select(self.builder.fcmp_ordered(sign, one, other), one, other),
        )

    def _halved(self, vector: Any, join: Callable[[Any, Any], Any]) -> Any:
        """Combine the upper half of a vector with the lower until one value remains; its length is a power
        of two.
        """
        while (half := vector.type.count // 2) > 0:
            lower, upper = (
                self.builder.shuffle_vector(
                    vector,
                    vector,
                    ir.Constant(ir.VectorType(ir.IntType(32), half), list(range(first, first + half))),
                )
                for first in (0, half)
            )
            vector = join(lower, upper)
        return self.builder.extract_element(vector, ir.IntType(32)(0))

    def min_of(self, vector: Any) -> Any:
        """Return the smallest byte of a vector."""
        kind = ir.FunctionType(BYTE, [vector.type])
        name = f"llvm.vector.reduce.umin.v{vector.type.count}i8"
        return self.builder.call(cgutils.get_or_insert_function(self.builder.module, kind, name), [vector])
