"""Whiskers that cannot be trusted are simulated again with finer steps, and some before it is known that they need it.

Few whiskers take a GPU as long as the one with most steps. With steps over 2, 5, 10 and 20 one after the other these
waits add up to 38 times that of the first simulation; with 2 and 5, then 10 and 20 at the same time to 26. But half of
the tries that are simulated ahead are not needed: where other whiskers would have the GPU meanwhile, they cost more
time than they save (benchmarks/RESULTS.md, "Sweeps on a GPU, by the public command").
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from brainbench.stimuli.engines.rod.launch import LaunchResult

Try = tuple[NDArray[np.bool_] | None, int]
"""Whiskers to simulate, all when None, and what divides their steps."""
Ahead = tuple[Sequence[int], Sequence[int]]
"""Multiples of ``retry`` by which steps are divided at once for whiskers in doubt: right after the first simulation,
and after that with steps over ``retry``."""
ONE_BY_ONE: Ahead = (), (2,)
"""Only what is needed: who is in doubt with steps over ``retry`` needs those over twice that, as a half or as a try."""
ON_AN_IDLE_GPU: Ahead = (1,), (2, 4)
"""Tries at the same time where nothing else waits for the GPU."""

_FIRST: Counter[str] = Counter()
"""First simulations that threads of this process have under way, by device."""
_LOCK = threading.Lock()


def run_with_retries(
    simulate: Callable[[Sequence[Try]], Sequence[LaunchResult]],
    retry: int,
    *,
    ahead: Callable[[], Ahead] = lambda: ONE_BY_ONE,
) -> LaunchResult:
    """Simulate whiskers, and those that finer steps may mend again: with steps over ``retry``, then over twice that.

    After each of these, suspicious whiskers are compared with half the step (:func:`.trust.halved`), at first
    with steps over ``retry`` where they meet a blow.

    Args:
        simulate: gives the results of tries, which may be simulated at the same time; whiskers of a mask are in its
            order, and alone.
        retry: 1 leaves all whiskers as they are.
        ahead: gives the tries to simulate before it is known whether they are needed, where further whiskers cost
            less time than further launches; asked before each. Results do not depend on it.
    """
    (result,) = simulate([(None, 1)])
    if retry == 1:
        return result
    known: dict[int, list[tuple[NDArray[np.bool_], LaunchResult]]] = {}

    def run(wanted: Mapping[int, NDArray[np.bool_]]) -> None:
        """Simulate whiskers, by what divides their steps, unless that was done before."""
        tries = []
        for finer, which in wanted.items():
            missing = which & ~np.any([some for some, _ in known.setdefault(finer, [])], axis=0)
            if missing.any():
                tries.append((missing, finer))
        for (which, finer), found in zip(tries, simulate(tries) if tries else (), strict=True):
            known[finer].append((which, found))

    def parts(which: NDArray[np.bool_], finer: int) -> Iterator[tuple[NDArray[np.bool_], LaunchResult]]:
        """Yield these whiskers in parts with their results."""
        for simulated, found in known[finer]:
            some = which & simulated
            if some.any():
                yield some, found.picked(some[simulated])

    left = np.ones_like(result.verdict.retryable)
    for place, finer in enumerate((1, retry, 2 * retry)):
        if finer > 1:
            left = result.verdict.retryable.copy()
            run({finer: left})
            for some, found in parts(left, finer):
                result = result.replaced(some, found)
        suspicious = result.verdict.suspicious & left
        doubtful = suspicious | result.verdict.retryable
        # Contacts may cut the step of a blow and its half to the same.
        divisors = np.where(result.verdict.struck, max(retry, 2 * finer), 2 * finer)
        compared = {int(divisor): suspicious & (divisors == divisor) for divisor in np.unique(divisors)}
        run(compared | {retry * k: doubtful for k in (*ahead(), ())[place]})
        for divisor, which in compared.items():
            for some, half in parts(which, divisor):
                result = result.compared(some, half)
    return result


@contextmanager
def first_simulation(device: Any) -> Iterator[None]:
    """Tell other threads that all whiskers of some sweeps are simulated on a device, which fills a GPU."""
    with _LOCK:
        _FIRST[device.alias] += 1
    try:
        yield
    finally:
        with _LOCK:
            _FIRST[device.alias] -= 1


def tries_ahead(device: Any) -> Ahead:
    """Return the tries ahead (:func:`run_with_retries`) as the device is busy now.

    One by one on a processor, and on a GPU while any thread simulates sweeps for the first time: as long as shards
    queue, one of those that run does.
    """
    return ON_AN_IDLE_GPU if device.is_cuda and not _FIRST[device.alias] else ONE_BY_ONE
