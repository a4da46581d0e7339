"""``brainbench stimuli``: list, show, simulate, draw and plot stimuli.

:mod:`~brainbench.cli.stimuli.scenes` shows and draws what a SOURCE names, ``simulate`` computes forces.
"""

from __future__ import annotations

from brainbench.cli.output import group, list_without_command
from brainbench.cli.stimuli import scenes, simulate

app = group(
    "Simulate whiskers on objects; look at scenes and forces.",
    [
        scenes.list_, scenes.show, simulate.simulate, simulate.sweep, simulate.separability, scenes.render, scenes.plot,
        scenes.objects,
    ],
)  # fmt: skip
list_without_command(app, scenes.list_)
