"""The main job: a model's responses and the animals' responses become a score.

:mod:`~brainbench.scoring.options` says how, :mod:`~brainbench.scoring.model_responses` runs the model on the stimuli,
:mod:`~brainbench.scoring.neural_responses` opens the recordings, and :mod:`~brainbench.scoring.scores` joins both into
a score and a result record. :mod:`~brainbench.scoring.jobs` finds the scores that a batch lacks.
"""

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.scoring.options import ScoreOptions
    from brainbench.scoring.scores import score, score_record

__all__ = ["ScoreOptions", "score", "score_record"]

__getattr__, __dir__ = lazy_exports(__name__)
