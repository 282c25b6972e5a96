"""The processor's prefetch instruction for compiled code."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

# Arguments of LLVM's prefetch: for reading, kept in all caches, data.
READ, KEEP, DATA = 0, 3, 1
LLVM_NAME = "llvm.prefetch.p0"


def _prefetch(context: Any, array: Any, index: Any) -> Any:
    """Prefetch an element of a flat array that is needed soon; unlike a read, nothing waits for it.

    Args:
        context: Typing context, passed by Numba.
        array: Flat array.
        index: Index into it, an unsigned integer.
    """

    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = target.make_array(signature.args[0])(target, builder, arguments[0]).data
        place = builder.bitcast(builder.gep(data, [arguments[1]]), ir.IntType(8).as_pointer())
        word = ir.IntType(32)
        function = ir.FunctionType(ir.VoidType(), [place.type, word, word, word])
        called = builder.module.globals.get(LLVM_NAME) or ir.Function(builder.module, function, LLVM_NAME)
        builder.call(called, [place, word(READ), word(KEEP), word(DATA)])
        return target.get_dummy_value()

    return types.void(array, index), generate


# For compiled code: prefetch(array, index).
prefetch: Any = intrinsic(_prefetch)
