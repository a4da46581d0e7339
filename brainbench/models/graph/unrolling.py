"""Which steps of which node must be computed at all when a graph is unrolled.

A connection that takes a step makes two cones: what the stimulus has not reached yet, and what no later answer
reads. Steps before the first are the same for every stimulus; steps in the second are left out.
"""

from __future__ import annotations

from collections.abc import Collection

from brainbench.models.graph.spec import GraphSpec, Unroll


def delays(spec: GraphSpec, unroll: Unroll) -> dict[tuple[str, str], int]:
    """Return how many steps each connection (source, target) takes: 1, or 0 within a step."""
    return {(e.source, e.target): 1 if unroll == "biological" or e.feedback else 0 for e in spec.edges}


def needed_steps(
    spec: GraphSpec, unroll: Unroll, steps: int, *, whole: Collection[str], last: Collection[str]
) -> dict[str, tuple[int, int]]:
    """Return for every node the steps (first, stop) to compute; stop 0 if none.

    Args:
        spec: The graph.
        unroll: How it is unrolled.
        steps: Length of the sweep.
        whole: Nodes of which every step is wanted.
        last: Nodes of which the last step is wanted.

    A node that remembers, or feeds back on itself, is computed from the first step on.
    """
    delay = delays(spec, unroll)
    first = {node.name: steps for node in spec.nodes}
    stop = {node.name: 0 for node in spec.nodes}
    for names, start in ((last, steps - 1), (whole, 0)):
        for name in names:
            first[name], stop[name] = min(first[name], start), steps
    looped = {name for group in spec.groups() if len(group) > 1 for name in group}
    looped |= {edge.source for edge in spec.edges if edge.source == edge.target}
    changed = True
    while changed:
        changed = False
        for name in reversed(spec.order):
            if stop[name] and first[name] and (spec.by_name[name].memory is not None or name in looped):
                first[name], changed = 0, True
            for edge in spec.predecessors(name):
                lag = delay[edge.source, name]
                begin, end = max(first[name] - lag, 0), stop[name] - lag
                if end > 0 and (begin < first[edge.source] or end > stop[edge.source]):
                    first[edge.source] = min(first[edge.source], begin)
                    stop[edge.source] = max(stop[edge.source], end)
                    changed = True
    return {name: (first[name], stop[name]) if stop[name] else (0, 0) for name in first}
