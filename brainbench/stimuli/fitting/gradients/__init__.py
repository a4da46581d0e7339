"""Gradients of simulated whiskers: of base wrenches, shapes and contact forces by whatever jobs are built from.

:class:`JobParameters` names parameters of jobs, :class:`GradientRun` simulates and differentiates
(:mod:`brainbench.stimuli.fitting.derivatives`), :class:`ContactEvents` say where a gradient holds on one side only.
"""

from brainbench.stimuli.fitting.gradients.parameters import JobParameters
from brainbench.stimuli.fitting.gradients.run import ContactEvents, Gradient, GradientRun, Tangents

__all__ = ["ContactEvents", "Gradient", "GradientRun", "JobParameters", "Tangents"]
