"""The main job: a model's responses and the animals' responses become a score.

:mod:`~brainbench.scoring.model_responses` runs the model on the stimuli, :mod:`~brainbench.scoring.neural_responses`
opens the recordings, :mod:`~brainbench.scoring.scores` joins both into a score and a result record.
"""

from brainbench.scoring.scores import score, score_record

__all__ = ["score", "score_record"]
