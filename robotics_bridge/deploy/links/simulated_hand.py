"""A simulated XHand1 behind a UDP socket: MuJoCo in real time, its own watchdog, and faults on request.

Runs as a process of its own: ``with simulated_hand() as address: …``. It holds a ball, palm up.
"""

from __future__ import annotations

import contextlib
import logging
import math
import multiprocessing
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, check_number
from brainbench.core.limits import Limit, Seed, Share, limited, read_pairs, with_changes
from robotics_bridge import hands
from robotics_bridge.deploy.controller import PressureCalibration
from robotics_bridge.deploy.driver import DriverRequest, HandReading
from robotics_bridge.deploy.links.udp import LOOPBACK, HandEnd, HandLink, UdpDriver, new_key
from robotics_bridge.hands.layouts import check_probes
from robotics_bridge.hands.observations import observation_type, observe, sensors_for
from robotics_bridge.hands.scenes import ARMATURE, OBJECT, holding
from robotics_bridge.physics import MujocoEngine
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.sensors import SensorSuite
from robotics_bridge.tasks.scenes import drives_of
from robotics_bridge.tasks.settings import CONTACTS, ContactModel, set_contacts

_LOG = logging.getLogger(__name__)

HOLD_AFTER = 0.25  # seconds without a command after which the hand holds by itself
_Delay = Annotated[float, Limit(least=0, below=3600, unit="s")]


@limited(of="fault '{}'")
class Faults:
    """Faults between hand and controller. Probabilities are per report."""

    drop: Share = 0.0
    """Probability that a report is lost."""
    delay: _Delay = 0.0
    """Seconds that reports are under way."""
    delay_after: _Delay = 0.0
    """Seconds from the start until that delay sets in."""
    jitter: _Delay = 0.0
    """Up to so many seconds more, drawn for each: reports overtake one another."""
    damage: Share = 0.0
    """Probability that a byte of a report is changed."""
    absurd: Share = 0.0
    """Probability that a joint is reported at 1000 rad."""
    nan: Share = 0.0
    """Probability that a joint's position is no number."""
    silent_after: _Delay = 0.0
    """Seconds after which the hand says nothing more; 0: never."""
    frozen_after: _Delay = 0.0
    """Seconds after which it repeats one report (its time too) under new numbers; 0: never."""
    seed: Seed = 0

    @classmethod
    def parse(cls, texts: list[str]) -> Faults:
        """Return the faults of texts such as ``drop=0.2``."""
        words = [name.replace("-", "_") + sign + value for name, sign, value in (text.partition("=") for text in texts)]
        return with_changes(cls(), read_pairs(words, "--fault", "drop=0.2"))


class SimulatedHand:
    """The physics and readings of the hand; the socket is :func:`serve`'s business.

    Args:
        rate: Reports per second; also the rate of the physics.
        observe: Observation type that its skin gives; reports need ``agg_force`` on the tips.
        twist: Torsional friction of force taxels (N·m·s); None: they hold what they touch.
        contacts: Firmness of contacts and strength of the drives.
    """

    def __init__(
        self,
        hand: str = "xhand1",
        rate: float = 200.0,
        *,
        observe: str = "agg_force",
        placement: str = "tips",
        resolution: str = "med",
        twist: float | None = None,
        contacts: ContactModel = CONTACTS["firm"],
    ) -> None:
        check_number("reports per second of a simulated hand", rate, least=10)
        self.hand, self.rate, self._substeps = hands.load(hand), rate, contacts.substeps
        # Drives as in the tasks: stiffness, damping, effort and armature together. A file may name its servos as it
        # likes, and leave joints without one.
        drives = drives_of(self.hand)
        body = holding(self.hand, timestep=1 / rate / contacts.substeps, servos=drives)
        set_contacts(body, contacts)
        servos = {body.joint(int(joint)).name: servo for servo, joint in enumerate(body.actuator_trnid[:, 0])}
        for name, servo in servos.items():
            stiffness, damping, effort = drives.get(name, (0.0, 0.0, 0.0))
            body.actuator_gainprm[servo, 0], body.actuator_biasprm[servo, 1:3] = stiffness, (-stiffness, -damping)
            body.actuator_forcelimited[servo], body.actuator_forcerange[servo] = 1, (-effort, effort)
            inertia = float(self.hand.model.joint(name).armature[0])
            body.dof_armature[body.joint(name).dofadr] = inertia or (ARMATURE if name in drives else 0.0)
        for numbers in (body.actuator_gainprm, body.actuator_biasprm, body.actuator_forcerange, body.dof_armature):
            numbers *= contacts.drive_scale
        self.engine = MujocoEngine(body, 1, threads=1)
        self.observe, self.layout = observe, self.hand.layout(resolution, placement)
        sensors = sensors_for(observe, self.layout, track=(OBJECT,), twist=twist)
        self.suite = SensorSuite(self.engine.scene, sensors, num_envs=1)
        self.suite.update(self.engine.state, 1 / rate)
        self.calibration = PressureCalibration()
        self.joints = self.hand.joints
        self.fingers = tuple(self.hand.fingers)
        model = self.engine.model
        self._positions = [int(model.joint(name).qposadr[0]) for name in self.joints]
        self._speeds = [int(model.joint(name).dofadr[0]) for name in self.joints]
        self._driven, self._drives = [self.joints.index(name) for name in servos], [*servos.values()]
        stiffness, damping = body.actuator_gainprm[self._drives, 0], -body.actuator_biasprm[self._drives, 2]
        self.lag = np.zeros(len(self.joints))
        """Time [J] (s) by which a damped drive follows a target that moves."""
        self.lag[self._driven] = np.divide(damping, stiffness, out=np.zeros(len(servos)), where=stiffness > 0)
        self._rows = [self.hand.tips.index(link) for link in self.layout if link in self.hand.tips]
        # The first step and reading load what later ones use; real time begins after them.
        self.step()
        self.touch()
        self.engine.reset()

    def hold(self) -> None:
        """Let the drives hold where the joints are."""
        self.drive(self.position)

    def drive(self, targets: NDArray[np.float64]) -> None:
        """Set the targets [J] (rad) of the position drives."""
        if np.shape(targets) != (len(self.joints),) or not np.isfinite(targets).all():
            raise UsageError(f"A hand takes {len(self.joints)} finite targets (rad); received {str(targets)[:80]}.")
        self.engine.data[0].ctrl[self._drives] = np.asarray(targets)[self._driven]

    @property
    def position(self) -> NDArray[np.float64]:
        """Joint positions [J] (rad)."""
        return self.engine.data[0].qpos[self._positions].copy()

    def place(self, position: NDArray[np.float64]) -> None:
        """Put the joints [J] (rad) at rest where they are said to be; what was felt before is forgotten."""
        self.engine.data[0].qpos[self._positions] = position
        self.engine.forward()
        self.suite.reset()

    def step(self) -> None:
        """Advance by one report."""
        self.engine.step(self._substeps)
        self.suite.update(self.engine.state, 1 / self.rate)

    def touch(self) -> NDArray[np.float32]:
        """Return what the skin gives [N, C]: items of the observation type, in the layout's order."""
        values = observe(self.observe, {link: self.suite.read(link) for link in self.layout}, self.layout)
        return values.view(-1, observation_type(self.observe).channels).numpy()

    def report(self) -> NDArray[np.float64]:
        """Return positions, velocities and pressures [2J + 3F]."""
        pressure = np.zeros((len(self.fingers), 3))
        pressure[self._rows] = self.touch()
        raw = self.calibration.pressure(self.fingers, pressure)
        return np.concatenate([self.position, self.engine.data[0].qvel[self._speeds], raw.ravel()])


APART = 0.3  # difference of a joint (rad; of a slide by its lever) at which a shadow is out of step
LOST = 0.25  # way of the ball (m) at which it has left the hand
MOST_STEPS = 2  # control steps that are made up for in one call


class ShadowTouch:
    """The tactile group [S, N, C] of a simulated hand that holds a ball and follows the reported joints.

    It begins where the first report has the joints, and keeps the time of the reports. What lies in the real hand is
    not known to it: the ball stands for the object, so touch that is not measured is a guess. Where that is none any
    more, because joints are blocked or the ball is gone, :meth:`summary` and a warning say so.

    Args:
        contract: Of the policy; hand, skin and contacts are those in which it was trained.
        joints: Names of the joints in the order of the reports.
    """

    def __init__(self, contract: PolicyContract, joints: tuple[str, ...]) -> None:
        if "tactile" not in contract.inputs:
            raise UsageError("The policy reads no touch, so none can be simulated beside the hand (--shadow).")
        stated = {name: getattr(contract, name) for name in ("placement", "resolution", "sub_steps")}
        if missing := [name for name, value in stated.items() if value is None]:
            raise UsageError(f"The contract does not say {missing[0]!r}, so no touch can be simulated beside the hand.")
        check_probes(stated["resolution"], contract.probes)
        self.sub_steps: int = stated.pop("sub_steps")
        senses = {**stated, "twist": contract.twist, "contacts": contract.contacts}
        self.hand = SimulatedHand(contract.hand, contract.rate * self.sub_steps, observe=contract.observe, **senses)
        # A hand need not report a joint that mimics another; the coupling moves it here too.
        reported = [(own, joints.index(name)) for own, name in enumerate(self.hand.joints) if name in joints]
        self._own, self._reported = (list(part) for part in zip(*reported, strict=True))
        self._lever = self.hand.hand.lever(self.hand.joints)[self._own]
        self._felt: deque[NDArray[np.float32]] = deque(maxlen=self.sub_steps)
        self._start, self._place, self._steps = math.nan, self._ball, 0
        self.apart = 0.0
        """Largest difference of a joint from the report that it followed (rad; of a slide by its lever)."""
        self.lost: float | None = None
        """Time (s) at which the ball left the hand."""

    def __call__(self, reading: HandReading) -> NDArray[np.float32]:
        """Advance to the time of a report, towards its joints, and return what was felt in the last control step."""
        where, hand = reading.position[self._reported], self.hand
        targets = hand.position
        targets[self._own] = where
        if math.isnan(self._start):
            hand.place(targets)
            self._start = reading.time - self.sub_steps / hand.rate
        # A damped drive would stay behind joints that move.
        targets[self._own] += hand.lag[self._own] * reading.velocity[self._reported]
        hand.drive(targets)
        behind = round((reading.time - self._start) * hand.rate) - self._steps
        for _ in range(min(behind, MOST_STEPS * self.sub_steps)):
            hand.step()
            self._felt.append(hand.touch().copy())
            self._steps += 1
        self._look(where)
        return np.stack(self._felt)

    @property
    def _ball(self) -> NDArray[np.float64]:
        return self.hand.engine.data[0].body(OBJECT).xpos.copy()

    def _look(self, where: NDArray[np.float64]) -> None:
        """Note how far the joints are from the reported ones, and whether the ball is gone; say each once."""
        differences = np.abs(self.hand.position[self._own] - where) / self._lever
        apart = float(differences.max())
        if self.apart <= APART < apart:
            joint = self.hand.joints[self._own[int(differences.argmax())]]
            _LOG.warning(
                "The simulated hand beside yours is %.2g rad from the report at joint %r, because the ball or a finger "
                "is in its way: its touch is that of another pose.", apart, joint,
            )  # fmt: skip
        self.apart = max(self.apart, apart)
        if self.lost is None and not np.linalg.norm(self._ball - self._place) <= LOST:
            self.lost = self._steps / self.hand.rate
            _LOG.warning(
                "The ball left the simulated hand after %.1f s: from now on its touch is that of an empty hand.",
                self.lost,
            )

    def summary(self) -> str:
        """Return how well the shadow followed, in words."""
        gone = "" if self.lost is None else f"; the ball left it after {self.lost:.1f} s"
        return f"joints of the simulated hand within {self.apart:.2g} rad of the reported ones{gone}"


def serve(hand: SimulatedHand, link: HandLink, faults: Faults, seconds: float = 3600.0) -> None:
    """Simulate in real time and answer until the time is over."""
    random = np.random.default_rng(faults.seed)
    start = time.monotonic()
    waiting: list[tuple[float, bytes]] = []
    heard, held, tick = start, True, 0
    frozen: tuple[NDArray[np.float64], float] | None = None
    hand.hold()
    while (now := time.monotonic()) - start < seconds:
        stamp = now - start
        targets = link.receive(stamp)
        if targets is not None:
            hand.drive(targets)
            heard, held = now, False
        elif not held and (link.stopped or now - heard > HOLD_AFTER):
            hand.hold()
            held = True
        hand.step()
        values = hand.report()
        if faults.frozen_after and stamp > faults.frozen_after:
            frozen = frozen or (values, stamp)
            values, stamp = frozen
        if link.peer and not (faults.silent_after and now - start > faults.silent_after):
            late = faults.delay if now - start >= faults.delay_after else 0.0
            # Each report waits by itself, so that jitter longer than a report's interval also changes their order.
            due = now + late + faults.jitter * random.random()
            waiting.extend((due, data) for data in _spoil(values, faults, random, len(hand.joints), link, stamp))
        for due, data in [item for item in waiting if item[0] <= now]:
            waiting.remove((due, data))
            link.send(data)
        tick += 1
        time.sleep(max(0.0, start + tick / hand.rate - time.monotonic()))


def _spoil(
    values: NDArray[np.float64], faults: Faults, random: np.random.Generator, joints: int, link: HandLink, stamp: float
) -> Iterator[bytes]:
    """Yield the report as faults leave it; nothing where it is lost."""
    drop, damage, absurd, nan = random.random(4)
    values = values.copy()
    if absurd < faults.absurd:
        values[int(random.integers(joints))] = 1000.0
    if nan < faults.nan:
        values[int(random.integers(joints))] = np.nan
    data = bytearray(link.report(values, stamp))
    if damage < faults.damage:
        data[int(random.integers(len(data)))] ^= 0xFF
    if drop >= faults.drop:
        yield bytes(data)


def _process(name: str, contacts: ContactModel, faults: Faults, seconds: float, key: bytes, ready: Any) -> None:
    hand = SimulatedHand(name, contacts=contacts)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind((LOOPBACK, 0))
        ready.send((link.getsockname()[1], hand.joints, hand.fingers))
        serve(hand, HandLink(link, key, len(hand.joints), len(hand.fingers)), faults, seconds)


def open_simulated(request: DriverRequest) -> contextlib.AbstractContextManager[UdpDriver]:
    """Return the driver of a simulated hand, which starts with it and has the contacts of the policy's training."""
    return _simulated(request, Faults.parse([*request.faults]))


@contextlib.contextmanager
def _simulated(request: DriverRequest, faults: Faults) -> Iterator[UdpDriver]:
    contract = request.contract
    end = simulated_hand(contract.hand, contacts=contract.contacts, faults=faults, seconds=request.seconds)
    with end as there, UdpDriver(*there) as driver:
        yield driver


@contextlib.contextmanager
def simulated_hand(
    hand: str = "xhand1", *, contacts: ContactModel = CONTACTS["firm"], faults: Faults | None = None,
    seconds: float = 600.0,
) -> Iterator[HandEnd]:  # fmt: skip
    """Run a simulated hand in a process of its own; yield its end of the link."""
    check_number("seconds of a simulated hand", seconds, above=0)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    key = new_key()
    given = (hand, contacts, faults or Faults(), seconds, key, theirs)
    process = context.Process(target=_process, args=given, daemon=True)
    process.start()
    theirs.close()
    try:
        if not ours.poll(120):
            raise DataError("The simulated hand did not start within two minutes.")
        try:
            port, joints, fingers = ours.recv()
        except EOFError:
            raise DataError("The simulated hand ended while it started.") from None
        yield HandEnd((LOOPBACK, port), joints, fingers, key)
    finally:
        process.terminate()
        process.join(5)
        ours.close()
