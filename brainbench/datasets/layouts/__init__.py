"""Layouts of published data sets: how the files of each are recognised, adapted, selected and labelled.

A session is matched by the columns of its trials (``registry``) and then adapted by its layout, before it is counted.
"""

from brainbench.datasets.layouts import published, registry
from brainbench.datasets.layouts.registry import register_layout

for _layout in (
    published.LAYOUT,
    published.DISCRIMINATION,
    published.DETECTION,
    published.YU,
    published.HIRES,
    published.AREA2_BUMP,
    registry.SYNTHETIC,
):
    register_layout(_layout)
