"""Specifications of hands hang together."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.hands.spec import CapsuleGeometry, HandSpec, Joint, Link, build


def test_a_hand_that_does_not_hang_together_is_refused():
    links = (Link("a", 0.1, (CapsuleGeometry((0, 0, 0), (0, 0, 1), 0.1),)), Link("b", 0.1), Link("c", 0.1))
    joint = Joint("j", "b", "c", (0, 0, 0), (0, 0, 0), (0, 0, 1), (0, 1), 1, 1, 1, 1, 0.1)
    with pytest.raises(UsageError, match=r"'broken' .*'b'"):
        build(HandSpec("broken", "a", links, (joint,), {}))
    with pytest.raises(UsageError, match="has no link 'd'"):
        HandSpec("broken", "a", links, (joint,), {"finger": ("d",)})
