"""Artificial networks of touch: what turns a whisker array's forces and torques into activations.

A name (:mod:`~brainbench.models.architecture`) is looked up in the :mod:`~brainbench.models.registry`, which builds an
encoder (often a temporal graph of cells), an attender and a decoder into a :mod:`~brainbench.models.network`; its
:mod:`~brainbench.models.activations` are what is compared with brains. Importing this package imports no framework.
"""

from brainbench.models import zoo

zoo.register()
