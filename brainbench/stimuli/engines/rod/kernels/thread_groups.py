"""Groups of threads that work on one thing and tell each other what they found."""

from functools import cache
from types import SimpleNamespace


@cache
def groups(real: type, lanes: int) -> SimpleNamespace:
    """Return what a group of ``lanes`` threads can tell each other; a group of one thread has nobody to ask.

    ``give(value, source)`` is the value that the thread ``source`` of the group has; ``total``, ``greatest``,
    ``least``, ``first`` (the least integer) and ``joined`` (bits) are taken over the group, ``most`` over its warp.
    All threads of a warp must call them together.
    """
    import warp as wp

    if lanes == 1:

        @wp.func
        def give(value: real, source: int) -> real:
            return value

        @wp.func
        def total(value: real) -> real:
            return value

        @wp.func
        def greatest(value: real) -> real:
            return value

        @wp.func
        def least(value: real) -> real:
            return value

        @wp.func
        def first(value: int) -> int:
            return value

        @wp.func
        def joined(bits: int) -> int:
            return bits

        @wp.func
        def most(value: int) -> int:
            return value

    else:

        def native(device_code: str, host_code: str = "return value;") -> str:
            return f"#if defined(__CUDA_ARCH__)\n{device_code}\n#else\n{host_code}\n#endif\n"

        def reduce(step: str, name: str = "value", width: int = lanes) -> str:
            return native(
                f"for (int o = {width // 2}; o > 0; o /= 2) {{ auto other = __shfl_xor_sync(0xffffffffu, {name}, o);"
                f" {step} }} return {name};",
                f"return {name};",
            )

        @wp.func_native(native(f"return __shfl_sync(0xffffffffu, value, source, {lanes});"))
        def give(value: real, source: int) -> real: ...

        @wp.func_native(reduce("value += other;"))
        def total(value: real) -> real: ...

        @wp.func_native(reduce("value = other > value ? other : value;"))
        def greatest(value: real) -> real: ...

        @wp.func_native(reduce("value = other < value ? other : value;"))
        def least(value: real) -> real: ...

        @wp.func_native(reduce("value = other < value ? other : value;"))
        def first(value: int) -> int: ...

        @wp.func_native(reduce("bits |= other;", "bits"))
        def joined(bits: int) -> int: ...

        @wp.func_native(reduce("value = other > value ? other : value;", width=32))
        def most(value: int) -> int: ...

    return SimpleNamespace(
        give=give, total=total, greatest=greatest, least=least, first=first, joined=joined, most=most
    )
