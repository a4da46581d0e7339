from dataclasses import fields, replace

from brainbench.cli.options import SCORE, SCORE_FLAGS, as_flags, option_fields
from brainbench.scoring import ScoreOptions

NAMES = [item.name for item in fields(ScoreOptions)]


def test_options_are_written_as_flags():
    assert as_flags(SCORE, ScoreOptions(), SCORE_FLAGS) == []
    options = replace(ScoreOptions(), layers=("a", "b"), normalize=False, explain=True, weights_seed=1)
    told = ["--layers", "a,b", "--no-normalize", "--weights-seed", "1", "--explain-estimator"]
    assert as_flags(SCORE, options, SCORE_FLAGS) == told
    assert set(option_fields(SCORE)) == set(NAMES)
