"""Layouts of published data sets: how the files of each are recognised, adapted, selected and labelled.

A session is matched by the columns of its trials (``registry``) and then adapted by its layout, before it is counted.
"""

from brainbench.datasets.layouts import area2_bump, pole, registry, rodgers
from brainbench.datasets.layouts.registry import register_layout

for _layout in (
    rodgers.LAYOUT,
    rodgers.DISCRIMINATION,
    rodgers.DETECTION,
    pole.YU,
    pole.HIRES,
    area2_bump.LAYOUT,
    registry.SYNTHETIC,
):
    register_layout(_layout)
