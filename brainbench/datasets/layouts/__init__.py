"""Layouts of published data sets: how the files of each are recognised, adapted, selected and labelled.

A session is matched by the columns of its trials (``registry``) and then adapted by its layout, before it is counted.
"""

from brainbench.datasets.layouts import adapted, registry, rodgers
from brainbench.datasets.layouts.registry import register_layout

for _layout in (
    rodgers.LAYOUT,
    rodgers.DISCRIMINATION,
    rodgers.DETECTION,
    adapted.YU,
    adapted.HIRES,
    adapted.AREA2_BUMP,
    registry.SYNTHETIC,
):
    register_layout(_layout)
