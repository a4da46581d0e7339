import sys

import numpy as np
import pytest

from brainbench.core.errors import DataError, MissingDependencyError, UsageError
from brainbench.datasets.whisking.dataset import WhiskingDataset
from brainbench.datasets.whisking.separability import separability, separate
from brainbench.stimuli.sweeps.generation import generate
from tests.factories.sweep_batches import small_plan

NAMES = ("a", "b", "c", "d")


def _made(*, classes=4, objects=10, sweeps=8, features=20, by_class=0.0, by_object=0.0, seed=0):
    """Gaussian features with so much spread between classes and between objects, and noise of 1."""
    draw = np.random.default_rng(seed)
    labels = np.repeat(np.arange(classes), objects * sweeps)
    owners = np.repeat(np.arange(classes * objects), sweeps)
    means = (
        by_class * draw.normal(size=(classes, features)),
        by_object * draw.normal(size=(classes * objects, features)),
    )
    values = means[0][labels] + means[1][owners] + draw.normal(size=(len(labels), features))
    return values.astype(np.float32), labels, np.array([f"o{owner:03d}" for owner in owners])


@pytest.mark.parametrize("count", [2, 3, 4])
def test_classes_far_apart_are_told_apart(count):
    found = separate(*_made(by_class=3.0), count=count, names=NAMES)
    assert found.accuracy > 0.98
    assert found.chance == 1 / count
    assert found.above_chance
    assert found.interval.low <= found.accuracy <= found.interval.high
    assert len(found.choices) == len(found.accuracies) == {2: 6, 3: 4, 4: 1}[count]
    assert found.status == "ok"


@pytest.mark.parametrize("count", [2, 4])
def test_what_tells_objects_but_not_classes_apart_stays_at_chance(count):
    # Sweeps of an object on both sides of a test would give an accuracy near one here.
    accuracies = [separate(*_made(by_object=3.0, seed=seed), count=count, names=NAMES) for seed in range(5)]
    assert abs(np.mean([found.accuracy for found in accuracies]) - 1 / count) < 0.08
    assert sum(found.above_chance for found in accuracies) <= 1


def test_the_interval_covers_the_true_accuracy_of_two_gaussians():
    # Two normal distributions a distance d apart are told apart with probability Φ(d/2) (Bayes' rule).
    from statistics import NormalDist

    distance, covered = 2.0, 0
    for seed in range(8):
        draw = np.random.default_rng(seed)
        labels = np.repeat([0, 1], 400)
        values = draw.normal(size=(800, 1)) + distance * labels[:, None]
        objects = np.array([f"o{i:03d}" for i in np.repeat(np.arange(40), 20)])
        found = separate(values, labels, objects, count=2, names=("a", "b"))
        covered += found.interval.low <= NormalDist().cdf(distance / 2) <= found.interval.high
    assert covered >= 6


def test_the_accuracy_is_that_of_a_scaled_radial_svc():
    from sklearn.model_selection import StratifiedGroupKFold, cross_val_score
    from sklearn.svm import SVC

    features, labels, objects = _made(by_class=0.6, seed=2)
    found = separate(features, labels, objects, count=4, names=NAMES, seed=3)
    folds = StratifiedGroupKFold(5, shuffle=True, random_state=3)
    expected = cross_val_score(SVC(C=10.0), features, labels, groups=objects, cv=folds)
    assert found.accuracies[0] == pytest.approx(expected.mean(), abs=0.01)


def test_when_every_object_is_right_the_interval_is_that_of_n_of_n():
    from scipy.stats import binomtest

    found = separate(*_made(by_class=30.0), count=2, names=NAMES)
    assert found.accuracy == 1
    exact = binomtest(40, 40).proportion_ci(0.95, method="exact")
    assert (found.interval.low, found.interval.high) == pytest.approx((exact.low, exact.high))


def test_few_objects_make_it_unreliable_and_one_makes_it_impossible():
    found = separate(*_made(objects=3, by_class=3.0), count=2, names=NAMES)
    assert found.status == "unreliable"
    assert "only 3 objects" in found.reason
    with pytest.raises(DataError, match="'a' has 1 object"):
        separate(*_made(objects=1), count=2, names=NAMES)


def test_more_classes_than_there_are_cannot_be_told_apart():
    with pytest.raises(UsageError, match="at least 2 and at most 4"):
        separate(*_made(), count=5, names=NAMES)


def test_without_scikit_learn_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.svm", None)
    with pytest.raises(MissingDependencyError, match=r"\[learn\]"):
        separate(*_made(), count=2, names=NAMES)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("sweeps")
    generate(small_plan(("brick:3", "cone:3", "pyramid:2"), whiskers="C2,C3"), path, workers=1)
    return WhiskingDataset(path, split="all", view="raw")


def test_simulated_sweeps_are_read_and_classes_chosen_by_their_objects(data):
    found, more = separability(data, counts=(2, 3), sweeps_per_class=12)
    assert found.choices == (("brick", "cone"), ("brick", "pyramid"), ("cone", "pyramid"))
    assert found.sweeps == 32
    assert found.objects == 8
    assert more.chance == pytest.approx(1 / 3)
    (pair,) = separability(data, classes=("cone", "brick"), counts=(2,))
    assert pair.choices == (("cone", "brick"),)
    assert separability(data, classes=("cone", "brick"), counts=(2,)) == (pair,)


def test_classes_that_the_data_set_does_not_have_are_named(data):
    with pytest.raises(UsageError, match="'bricks'; did you mean 'brick'"):
        separability(data, classes=("bricks", "cone"), counts=(2,))
    with pytest.raises(UsageError, match="3 classes; 4 at a time"):
        separability(data)
    with pytest.raises(UsageError, match="received cone, brick"):
        separability(data, classes=("cone", "brick"), counts=(2, 3))
    with pytest.raises(UsageError, match="'cone' more than once"):
        separability(data, classes=("cone", "cone", "brick"), counts=(2,))
