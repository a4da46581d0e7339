"""Simulated touch beside a hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.deploy.controller import RealTouch
from robotics_bridge.deploy.driver import HandReading
from robotics_bridge.deploy.links.simulated_hand import ShadowTouch, SimulatedHand, simulated_hand
from robotics_bridge.hands.scenes import closing
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.tasks.settings import CONTACTS
from tests.factories.paper_hands import still_map
from tests.robotics_bridge.hands.test_grippers import JAWS, LINK, URDF

HAND = hands.load("xhand1")


def _reading(position, pressure=None, *, step: int = 0, velocity=None) -> HandReading:
    pressure = np.zeros((5, 3)) if pressure is None else pressure
    velocity = np.zeros(12) if velocity is None else velocity
    return HandReading(step, step / 40, step / 40, np.asarray(position), velocity, pressure)


def _contract(observe: str, joints: tuple[str, ...] = HAND.joints) -> PolicyContract:
    links = tuple(HAND.layout("low", "hand"))
    more = {"placement": "hand", "resolution": "low", "sub_steps": 5, "twist": None, "contacts": CONTACTS["firm"]}
    inputs, still = {"tactile": (5, len(links), 3)}, still_map(joints)
    return PolicyContract(inputs, 40.0, "xhand1", joints, joints, still, {}, links, observe, **more)


def test_it_follows_the_reported_joints_whatever_their_order_and_feels_the_ball() -> None:
    joints = HAND.joints[::-1]
    shadow = ShadowTouch(_contract("force_torque", joints), joints)
    closed = closing(HAND, 0.5)
    order = [joints.index(name) for name in HAND.joints]
    reported = np.empty(12)
    reported[order] = closed[[HAND.joints.index(name) for name in HAND.joints]]
    for step in range(40):
        felt = shadow(_reading(reported, step=step))
    assert felt.shape == (5, 90, 6)
    assert np.isfinite(felt).all()
    assert np.abs(felt[..., :3]).max() > 0.01
    assert np.abs(shadow.hand.position - reported[order]).mean() < 0.2


def test_a_shadow_begins_where_the_hand_is_and_does_not_stay_behind_joints_that_move() -> None:
    pinky, rate = np.arange(12) == 10, 2 * np.pi
    middle, amplitude = 0.7 * pinky, 0.2 * pinky
    shadow = ShadowTouch(_contract("force_torque"), HAND.joints)
    apart = []
    for step in range(60):
        phase = rate * step / 40
        position, velocity = middle + amplitude * np.sin(phase), rate * amplitude * np.cos(phase)
        shadow(_reading(position, step=step, velocity=velocity))
        apart.append(np.abs(shadow.hand.position - position).max())
    assert max(apart) < 0.05  # a drive of .1 s stays .12 rad behind
    assert shadow.apart == max(apart)
    assert "0.0" in shadow.summary()


def test_a_shadow_keeps_the_time_of_the_reports() -> None:
    """Of ten reports two were lost and one came twice."""
    shadow = ShadowTouch(_contract("force_torque"), HAND.joints)
    for step in (0, 1, 4, 5, 5, 6, 7, 8, 9):
        assert shadow(_reading(np.zeros(12), step=step)).shape == (5, 90, 6)
    assert shadow.hand.engine.data[0].time == pytest.approx(10 / 40)


def test_a_shadow_that_is_blocked_or_lost_its_ball_says_so(caplog) -> None:
    shadow = ShadowTouch(_contract("force_torque"), HAND.joints)
    low, high = HAND.model.jnt_range.T  # all at once: thumb and fingers meet
    for step in range(100):
        shadow(_reading(low + (high - low) * min(1, step / 40), step=step))
    assert shadow.apart > 0.3
    assert shadow.lost is not None
    assert 0.5 < shadow.lost < 2.5
    assert [text for record in caplog.records if "simulated hand" in (text := record.getMessage())] == [
        text for text in caplog.messages if "rad from the report" in text or "empty hand" in text
    ]
    assert f"the ball left it after {shadow.lost:.1f} s" in shadow.summary()


@pytest.mark.parametrize("armature", ["", 'armature=".01"'])
def test_a_file_drives_joints_as_the_tasks_do_whatever_its_servos_are_called(tmp_path, armature) -> None:
    """A joint without a servo gets the weak one of the tasks: a policy moves it too."""
    jaw = (
        '<body pos="0 {1} .05"><joint name="{0}" axis="{2} 0 0" range="0 1" {3}/>'
        '<geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></body>'
    )
    jaws = "".join(jaw.format(*each, armature) for each in (("a", 0.2, 1), ("b", -0.2, -1), ("free", 0.4, 1)))
    (tmp_path / "hand.xml").write_text(
        f'<mujoco><compiler angle="radian"/><worldbody><body name="palm"><geom type="box" size=".05 .05 .01"/>{jaws}'
        '</body></worldbody><actuator><position name="servo b" joint="b" kp="5" kv=".5"/>'
        '<position name="servo a" joint="a" kp="5" kv=".5"/></actuator></mujoco>'
    )
    hand = SimulatedHand(str(tmp_path / "hand.xml"))
    hand.drive(np.array([0.1, 0.2, 0.3]))
    for _ in range(200):
        hand.step()
    assert hand.position == pytest.approx([0.1, 0.2, 0.3], abs=0.05)  # the weak one sags
    model, scale = hand.engine.model, CONTACTS["firm"].drive_scale
    assert model.dof_armature[[model.joint(name).dofadr[0] for name in hand.joints]] == pytest.approx(0.01 * scale)


def test_a_joint_that_mimics_another_need_not_be_reported_and_drives_are_those_of_the_tasks(tmp_path) -> None:
    (tmp_path / "jaws.urdf").write_text(URDF.format(links="".join(LINK.format(*jaw) for jaw in JAWS)))
    contract = replace(_contract("agg_force", ("l",)), hand=str(tmp_path / "jaws.urdf"))
    shadow = ShadowTouch(replace(contract, inputs={"tactile": (5, 3, 3)}), ("l",))
    model, data = shadow.hand.engine.model, shadow.hand.engine.data[0]
    for step in range(40):
        shadow(_reading([0.02], np.zeros((2, 3)), step=step))
        assert np.abs(data.actuator_force).max() <= 0.8 + 1e-9  # 8 % of the 10 N that the file states
    assert data.qpos[[model.joint(name).qposadr[0] for name in "lr"]] == pytest.approx([0.02, 0.02], abs=2e-3)


def test_its_contacts_are_those_of_the_policy() -> None:
    """A ball on the palm sinks in less under firm contacts, and drives of a scaled strength move the fingers alike."""
    depth, way = {}, {}
    for name, contacts in CONTACTS.items():
        hand = SimulatedHand(contacts=contacts)
        hand.drive(hand.position + 0.3)
        for _ in range(20):
            hand.step()
        way[name] = hand.position
        hand.drive(np.zeros(12))
        for _ in range(200):
            hand.step()
        state = hand.engine.state
        depth[name] = -float(state.contact_distance.numpy()[: int(state.contact_count.numpy()[0])].min())
    assert 0 < depth["firm"] < 0.3 * depth["published"]
    assert np.abs(way["firm"] - way["published"]).max() < 0.03


def test_measured_links_replace_simulated_ones() -> None:
    contract = _contract("agg_force")
    shadow = ShadowTouch(contract, HAND.joints)
    layout = HAND.layout("low", "hand")
    tips = {chain[-1]: finger for finger, chain in HAND.fingers.items()}
    touch = RealTouch(contract, tuple(HAND.fingers), fallback=shadow)
    pressure = np.full((5, 3), 0.01)
    for step in range(20):
        felt = touch(_reading(np.zeros(12), pressure, step=step))
    tip_rows = [row for row, link in enumerate(layout) if link in tips]
    np.testing.assert_allclose(felt[:, tip_rows], np.broadcast_to([-10.0, -10.0, 10.0], (5, 5, 3)), rtol=1e-5)
    palm = list(layout).index(HAND.palm)
    assert np.abs(felt[:, palm]).max() > 0.1  # the ball lies on the simulated palm


@pytest.mark.parametrize("targets", [np.zeros(3), np.full(12, np.nan), 0.5])
def test_a_simulated_hand_takes_a_finite_target_per_joint(targets) -> None:
    with pytest.raises(UsageError, match="12 finite targets"):
        SimulatedHand().drive(targets)


@pytest.mark.parametrize("options", [{"seconds": np.nan}, {"seconds": -1.0}])
def test_a_simulated_hand_is_not_started_for_a_time_that_is_none(options) -> None:
    with (
        pytest.raises(UsageError, match=rf"simulated hand .*{next(iter(options.values()))}"),
        simulated_hand(**options),
    ):
        pass
