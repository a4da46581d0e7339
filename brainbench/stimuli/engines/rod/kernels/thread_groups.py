"""Groups of threads that work on one thing and tell each other what they found.

``broadcast(value, source)`` is the value that the thread ``source`` of the group has; ``group_sum``, ``group_max``,
``group_min``, ``group_min_int`` and ``group_or`` (of bits) are taken over the group, ``warp_max`` over its warp. All
threads of a warp must call them together. A group of one thread, as on a processor, has nobody to ask.
"""

import warp as wp

from .parameters import group_size, real

if group_size == 1:

    @wp.func
    def broadcast(value: real, source: int) -> real:
        """Return the value: a group of one thread has no other."""
        return value

    @wp.func
    def group_sum(value: real) -> real:
        """Return the value, as every reduction over one thread does."""
        return value

    @wp.func
    def warp_max(value: int) -> int:
        """Return the integer, as every reduction of integers over one thread does."""
        return value

    group_max = group_min = group_sum
    group_min_int = group_or = warp_max

else:

    def native(device_code: str, host_code: str = "return value;") -> str:
        """Return the text of native code: one for a GPU, one for a processor."""
        return f"#if defined(__CUDA_ARCH__)\n{device_code}\n#else\n{host_code}\n#endif\n"

    def reduce(step: str, name: str = "value", width: int = group_size) -> str:
        """Return the code of a butterfly reduction over ``width`` threads."""
        return native(
            f"for (int o = {width // 2}; o > 0; o /= 2) {{ auto other = __shfl_xor_sync(0xffffffffu, {name}, o);"
            f" {step} }} return {name};",
            f"return {name};",
        )

    @wp.func_native(native(f"return __shfl_sync(0xffffffffu, value, source, {group_size});"))
    def broadcast(value: real, source: int) -> real:
        """Return the value of the thread ``source`` of the group."""

    @wp.func_native(reduce("value += other;"))
    def group_sum(value: real) -> real:
        """Return the sum over the group."""

    @wp.func_native(reduce("value = other > value ? other : value;"))
    def group_max(value: real) -> real:
        """Return the largest value of the group."""

    @wp.func_native(reduce("value = other < value ? other : value;"))
    def group_min(value: real) -> real:
        """Return the smallest value of the group."""

    @wp.func_native(reduce("value = other < value ? other : value;"))
    def group_min_int(value: int) -> int:
        """Return the smallest integer of the group."""

    @wp.func_native(reduce("bits |= other;", "bits"))
    def group_or(bits: int) -> int:
        """Return the bits that any thread of the group has set."""

    @wp.func_native(reduce("value = other > value ? other : value;", width=32))
    def warp_max(value: int) -> int:
        """Return the largest integer of the warp."""
