"""Drivers come from entry points; what is wrong with a request is said before a hand is touched."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.driver import DriverRequest, open_driver
from robotics_bridge.policies.contract import PolicyContract
from tests.factories.paper_hands import still_map

CONTRACT = PolicyContract({"proprio": (36,)}, 40.0, "xhand1", ("a",), ("a",), still_map(("a",)), {})


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("simm", {}, "did you mean 'sim'"),
        ("udp", {"address": "host:0"}, "received 'host:0'"),
        ("udp", {"address": ":5000"}, "--key"),
        ("sim", {"faults": ("drp=0.2",)}, "did you mean 'drop'"),
    ],
)
def test_a_request_that_no_driver_serves_is_refused(name: str, changes: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        open_driver(name, DriverRequest(contract=CONTRACT, **changes))
