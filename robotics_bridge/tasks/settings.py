"""Settings of tasks: contacts and the drives that press on them, learning of teachers and students (tables 4.4, 4.5).

SI units, radians.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Literal

from brainbench.core.errors import UsageError, brief, check_each, check_numbers
from brainbench.core.limits import Count, Limit, NotNegative, Positive, Share, limited

Range = Annotated[tuple[float, float], Limit(rising=True)]  # lower and upper bound of a uniform distribution
Factors = Annotated[tuple[NotNegative, NotNegative], Limit(rising=True)]  # the same of numbers that are not negative
Span = Annotated[tuple[Positive, Positive], Limit(rising=True)]  # and of positive ones


def unit_vector(name: str, value: Any, count: int) -> tuple[float, ...]:
    """Return an axis (3 numbers) or a quaternion (4) of unit length; one that has it stays as it is."""
    check_numbers(name, value, count)
    length = math.hypot(*value)
    if not length > 0:
        raise UsageError(f"{name} has no length; received {brief(value)}.")
    # Numbers that are written with a few digits count as they are written.
    return tuple(value) if abs(length - 1) < 1e-6 else tuple(one / length for one in value)


def check_parameters(of: str, function: Callable[..., Any], given: Iterable[str]) -> None:
    """Check that a function of a :class:`~robotics_bridge.tasks.terms.StepContext` can be called by these names.

    It takes the context first. Messages call it ``of`` (``reward 'work' of task 'mine'``).
    """
    if not callable(function):
        raise UsageError(f"The {of} needs a function of a step; received {brief(function)}.")
    try:
        signature = inspect.signature(function)
    except ValueError:  # Written in C, which tells no parameters.
        return
    parameters = list(signature.parameters.values())[1:]
    if not any(one.kind is one.VAR_KEYWORD for one in parameters):
        check_each(f"parameter of {of}", given, [one.name for one in parameters if one.kind is not one.VAR_POSITIONAL])
    try:
        signature.bind(None, **dict.fromkeys(given))
    except TypeError as error:
        raise UsageError(f"The {of} cannot be called: {error}.") from None


@limited(of="contacts.{}", kw_only=True)
class ContactModel:
    """Compliance of all contacts (MuJoCo's ``solref`` and ``solimp``), physics steps, and the scale of the drives."""

    time_constant: Positive = 0.02
    """Time in which the solver takes overlap away [s]; the published engine's default."""
    damping_ratio: Positive = 1.0
    """Damping of that approach; 1 is critical."""
    impedance: tuple[float, float, float] = (0.9, 0.95, 0.001)
    """Share of the constraint that is enforced at no overlap and at a full one, and the depth of a full one [m]."""
    substeps: Annotated[int, Limit(least=1, most=100)] = 1
    """Physics steps within the solver's ``timestep``; drives and sensors keep the rate of that."""
    drive_scale: Positive = 1.0
    """Factor on stiffness, damping, effort and armature of the hand's drives. Free motion depends on their ratios
    alone, so it stays the same; the force of a blocked finger and the blow of a fast one become smaller."""

    def __post_init__(self) -> None:
        low, high, width = self.impedance
        if not (0 < low <= high < 1 and width > 0):
            raise UsageError(
                "contacts.impedance is two shares between 0 and 1 in order, and a depth above 0 (m); received "
                f"{self.impedance}."
            )


CONTACTS = {"published": ContactModel(), "firm": ContactModel(time_constant=0.006, substeps=2, drive_scale=0.08)}
"""Named contact models. Under ``published`` a block lies millimetres inside the fingers that press it with the released
efforts; ``firm``, on which we train, keeps 95 % of the contacts below 1 mm and of the forces below 20 N
(docs/tasks.md)."""


def contacts_name(contacts: ContactModel) -> str:
    """Return the name of a contact model, ``its own`` for one without."""
    return next((name for name, model in CONTACTS.items() if model == contacts), "its own")


def set_contacts(model: Any, contacts: ContactModel) -> None:
    """Give all geometries of a ``mujoco.MjModel`` this compliance; MuJoCo's sigmoid keeps its middle and power."""
    model.geom_solref[:] = contacts.time_constant, contacts.damping_ratio
    model.geom_solimp[:, :3] = contacts.impedance


BOUNDED = "robotics_bridge.policies.training.bounded_ppo:BoundedPPO"
"""The algorithm of runs whose learning rate has other bounds than rsl_rl's."""
_WIDEST = (1e-5, 1e-2)

Widths = Annotated[tuple[Annotated[int, Limit(least=1, most=65_536)], ...], Limit(shortest=1)]
"""Widths of the hidden layers of a network."""
LearningRate = Annotated[float, Limit(above=0, most=1)]
Loss = Literal["mse", "inv_var_mse"]


@limited(of="{} of a teacher", kw_only=True)
class TeacherSettings:
    """PPO of the privileged teacher, upper half of table 4.4."""

    num_envs: Count = 8192
    """Environments at once."""
    steps_per_env: Count = 24
    """Control steps of every environment in an iteration."""
    iterations: Annotated[int, Limit(least=0)] = 6000
    learning_rate: float = 1e-3
    """Learning rate of the first iteration."""
    epochs: Count = 5
    """Passes over the steps of an iteration."""
    minibatches: Count = 4
    """Parts of a pass, a gradient step each."""
    discount: Share = 0.998
    """γ, per control step."""
    gae_lambda: Share = 0.95
    """λ of the advantages (Schulman et al. 2016)."""
    clip: Positive = 0.2
    """Largest change of an action's likelihood ratio that still pays (ε of PPO)."""
    desired_kl: Positive = 0.01
    """Aim of the adaptive learning rate."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """``adaptive``: the rate follows the KL divergence of updates; ``fixed``: it stays."""
    learning_rate_range: Span = (1e-5, 1e-2)
    """Bounds of the adaptive rate; the widest are those of rsl_rl."""
    entropy: NotNegative = 2e-3
    """Weight of the bonus for spread actions."""
    value_loss: NotNegative = 1.0
    """Weight of the critic's loss."""
    max_grad_norm: Positive = 1.0
    """Norm to which longer gradients are cut."""
    hidden: Widths = (512, 256, 128)
    """Widths of the layers of actor and critic."""
    initial_std: Positive = 1.0
    """Standard deviation of the first actions."""
    std_type: str = "log"
    """Form of the policy's standard deviation (text above table 4.4; the released settings say ``log``)."""
    std_range: Span = (1e-6, 1e6)
    """Bounds of the standard deviation of actions."""
    rnd_weight: NotNegative = 100.0
    """Weight of the curiosity reward, per second; 0 trains without it."""
    rnd_outputs: Count = 8
    """Numbers of the random network that the curious one predicts (Burda et al. 2018)."""
    rnd_learning_rate: NotNegative = 1e-3
    """Learning rate of the predicting network."""

    def __post_init__(self) -> None:
        low, high = self.learning_rate_range
        if not _WIDEST[0] <= low <= self.learning_rate <= high <= _WIDEST[1]:
            raise UsageError(
                f"A learning rate lies within its range, and that within {_WIDEST}; received {self.learning_rate!r} "
                f"and {(low, high)}."
            )

    def config(self, groups: dict[str, tuple[str, ...]], actor: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the configuration of rsl_rl 5 (``PPO.construct_algorithm``), given observation set → groups.

        ``actor`` names another model class of the actor with its own settings.
        """
        network = {
            "class_name": "MLPModel", "hidden_dims": list(self.hidden), "activation": "elu", "obs_normalization": True,
        }  # fmt: skip
        spread = {
            "class_name": "GaussianDistribution", "init_std": self.initial_std, "std_type": self.std_type,
            "std_range": list(self.std_range),
        }  # fmt: skip
        algorithm: dict[str, Any] = {
            "class_name": "PPO", "num_learning_epochs": self.epochs, "num_mini_batches": self.minibatches,
            "learning_rate": self.learning_rate, "schedule": self.schedule, "desired_kl": self.desired_kl,
            "gamma": self.discount, "lam": self.gae_lambda, "entropy_coef": self.entropy, "clip_param": self.clip,
            "max_grad_norm": self.max_grad_norm, "value_loss_coef": self.value_loss, "use_clipped_value_loss": True,
        }  # fmt: skip
        if tuple(self.learning_rate_range) != _WIDEST:
            algorithm |= {"class_name": BOUNDED, "learning_rate_range": list(self.learning_rate_range)}
        sets = {name: list(groups[name]) for name in ("actor", "critic")}
        if self.rnd_weight:
            sets["rnd_state"] = list(groups["rnd_state"])
            algorithm["rnd_cfg"] = {
                "weight": self.rnd_weight, "reward_normalization": True, "state_normalization": True,
                "learning_rate": self.rnd_learning_rate, "num_outputs": self.rnd_outputs,
                "predictor_hidden_dims": [-1], "target_hidden_dims": [-1],
            }  # fmt: skip
        return {
            "num_steps_per_env": self.steps_per_env,
            "obs_groups": sets,
            "actor": {**network, **(actor or {}), "distribution_cfg": spread},
            "critic": dict(network),
            "algorithm": algorithm,
            "multi_gpu": None,
        }


@limited(of="{} of a student", kw_only=True)
class StudentSettings:
    """DAgger distillation of the tactile student, lower half of table 4.4."""

    iterations: Annotated[int, Limit(least=0)] = 6000
    learning_rate: LearningRate = 1e-4
    epochs: Count = 5
    """Passes over the steps of an iteration."""
    gradient_length: Count = 2
    """Steps through which gradients flow back in time."""
    clip: Annotated[float, Limit(above=0, most=100)] | None = None
    """Largest change of an action within an iteration that still lowers the loss; None for any."""
    max_grad_norm: Annotated[float, Limit(above=0, most=1e6)] | None = None
    """Norm to which longer gradients are cut; None leaves them."""
    loss: Loss = "mse"
    """``inv_var_mse``: each action's squared error over the variance of the teacher's action in the rollout."""


@limited(of="{} of a decoder")
class AuxiliaryDecoder:
    """A head that predicts an observation group from the student's latent (table 4.5)."""

    target: str
    """Name of the group."""
    weight: NotNegative = 1.0
    """Weight of its mean squared error in the loss."""
    scale: float = 1.0
    """Factor on the target."""
    hidden: Widths = (128, 64)
    """Widths of its layers."""
