import numpy as np
import pytest

from brainbench.stimuli.engines.displaced import move_obstacle
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle

PART = Capsule((0.0, 0.0, -1e-3), (2e-3, 0.0, 3e-3), 2e-4)


class Slide:
    finest = 0.02

    def __call__(self, times):
        return np.outer(times, [0.1, 0.2, 0.0]), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))


def test_a_shifted_motion_keeps_its_turn_and_its_shortest_period():
    times, moved = np.linspace(0, 0.1, 5), move_obstacle(Obstacle((PART,), Slide()), (1e-3, 0.0, -2e-3))
    place, turn = moved.motion(times)
    np.testing.assert_array_equal(place, Slide()(times)[0] + [1e-3, 0.0, -2e-3])
    np.testing.assert_array_equal(turn, Slide()(times)[1])
    assert moved.motion.finest == Slide.finest


def test_an_obstacle_turns_about_its_middle():
    obstacle = Obstacle((PART,))
    moved = move_obstacle(obstacle, (0.0, 1e-3, 0.0), (0.0, 0.0, np.pi))
    shift = moved.bounds.mean(axis=0) - obstacle.bounds.mean(axis=0)
    assert shift == pytest.approx([0.0, 1e-3, 0.0])
    assert moved.parts[0] != obstacle.parts[0]
