"""The network of a policy as a model class of rsl_rl: groups of observations → encoders → head → actions.

Name it in a configuration as ``class_name="robotics_bridge.policies.student:TactilePolicy"``. Each flat group passes an
encoder of its own, ``tactile`` [B, S, N, C] one of :mod:`~robotics_bridge.policies.encoders.arms`; the head is a
multilayer perceptron. All memory is one array [1, B, H], as rsl_rl stores it, and exports are complete: normalisers,
taxel grid, encoder, head and memory. Letters: B batch, T time, H state, D latent, A action.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from brainbench.core.errors import UsageError, check_name
from robotics_bridge.policies.encoders.arms import (
    EncoderConfig,
    FeatureNorm,
    Stepped,
    TactileEncoder,
    elu_perceptron,
    recur,
)

_LEAST = 1e-2  # added to the deviations, as rsl_rl does


class ObservationNormaliser(nn.Module):
    """Centre and scale observations [B, n] by the mean and deviation that were seen in training."""

    _mean: torch.Tensor
    _std: torch.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        for name, value in (("_mean", 0.0), ("_var", 1.0), ("_std", 1.0)):
            self.register_buffer(name, torch.full((1, size), value))
        self.register_buffer("count", torch.tensor(0))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the normalised observations [B, n]."""
        return (x - self._mean) / (self._std + _LEAST)


class ActingModel(nn.Module):
    """The part of rsl_rl's ``MLPModel`` that acts, with its arguments; ``distribution_cfg`` is not used."""

    def __init__(
        self,
        obs: Mapping[str, torch.Tensor],
        obs_groups: Mapping[str, Sequence[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: Sequence[int],
        activation: str = "elu",
        obs_normalization: bool = True,
        distribution_cfg: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if activation != "elu":
            raise ValueError(f"The activation is 'elu'; received {activation!r}.")
        self.distribution = None
        self.obs_groups, size = self._get_obs_dim(obs, obs_groups, obs_set)
        self.obs_normalization = obs_normalization
        self.obs_normalizer = ObservationNormaliser(size) if obs_normalization else nn.Identity()
        self.mlp = elu_perceptron(self._get_latent_dim() or size, hidden_dims, output_dim)

    def forward(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the mean actions [B, A]."""
        return self.mlp(self.get_latent(obs))

    def get_latent(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the normalised observations [B, n]."""
        return self.obs_normalizer(torch.cat([obs[name] for name in self.obs_groups], dim=-1))

    def reset(self, dones: torch.Tensor | None = None) -> None:
        """Forget nothing: there is no memory."""

    def _get_obs_dim(
        self, obs: Mapping[str, torch.Tensor], obs_groups: Mapping[str, Sequence[str]], obs_set: str
    ) -> tuple[list[str], int]:
        names = list(obs_groups[obs_set])
        return names, sum(obs[name].shape[-1] for name in names)

    def _get_latent_dim(self) -> int:
        return 0


if TYPE_CHECKING:
    from rsl_rl.models import MLPModel
    from tensordict import TensorDict
else:
    try:
        from rsl_rl.models import MLPModel
    except ImportError:  # who only plays a trained student needs no package for training
        from robotics_bridge.policies.student import ActingModel as MLPModel

TACTILE = "tactile"  # name of the group of readings
EMBEDDERS = ("none", "mlp", "lstm")
_EMBEDDING, _WIDTHS, _LSTM = 64, (512, 256, 128), 128  # of flat groups (thesis, section 4.3.4)


class GroupEncoder(nn.Module):
    """The embedding of a flat group [B, n]: nothing, an MLP [512, 256, 128] → 64, or an LSTM 128 → 64."""

    def __init__(self, size: int, kind: str) -> None:
        super().__init__()
        check_name("encoder of a flat group", kind, EMBEDDERS)
        self.features, self.state_size = (_EMBEDDING, 0) if kind != "none" else (size, 0)
        self.cell: nn.LSTMCell | None = None
        self.net: nn.Module = nn.Identity()
        if kind == "mlp":
            self.net = elu_perceptron(size, _WIDTHS, _EMBEDDING)
        elif kind == "lstm":
            self.cell, self.net = nn.LSTMCell(size, _LSTM), nn.Linear(_LSTM, _EMBEDDING)
            self.state_size = 2 * _LSTM

    def unroll(self, x: torch.Tensor, h_in: torch.Tensor, ended: torch.Tensor | None) -> Stepped:
        """Return (embeddings [L, B, …], h_out) of L steps [L, B, n]; memory is forgotten where ``ended`` [L, B]."""
        if self.cell is None:
            return self.net(x), h_in
        # Memory may be forgotten between any two steps; what has none follows as one batch.
        hidden, h_out = recur(self._remember, x, h_in, ended)
        return self.net(hidden), h_out

    def _remember(self, x: torch.Tensor, state: torch.Tensor) -> Stepped:
        hidden, memory = self.cell(x, state.chunk(2, 1))  # type: ignore[misc]
        return hidden, torch.cat((hidden, memory), 1)


class PolicyCore(nn.Module):
    """Observations → latent, all memory in one array; ``sizes`` gives the length of each flat group, in order."""

    def __init__(self, sizes: Mapping[str, int], embedder: str, tactile: TactileEncoder | None) -> None:
        super().__init__()
        self.groups = tuple(sizes)
        self.embedders = nn.ModuleList(GroupEncoder(size, embedder) for size in sizes.values())
        self.tactile: TactileEncoder | None = tactile
        self.splits: list[int] = [*(int(part.state_size) for part in self.embedders)]  # type: ignore[arg-type]
        # Runtimes know no empty arrays, so a policy without memory carries one number that stays zero.
        self.stored_size: int = sum(self.splits) or 1
        """Numbers of memory per row where a frozen encoder's features are stored, so that it needs none here."""
        self.state_size: int = sum(self.splits) + (tactile.state_size if tactile is not None else 0) or 1
        """H."""
        self.features: int = sum(int(part.features) for part in self.embedders)  # type: ignore[arg-type]
        self.features += tactile.features if tactile is not None else 0
        self.precision: torch.dtype | None = None
        """Precision of the tactile encoder while :meth:`unroll` runs (mixed); None for that of its weights."""

    def unroll(
        self, flat: Sequence[torch.Tensor], taxels: torch.Tensor | None, h_in: torch.Tensor,
        ended: torch.Tensor | None = None,
    ) -> Stepped:  # fmt: skip
        """Return (latents [L, B, D], h_out) of normalised flat groups [L, B, n] and readings [L, B, S, N, C].

        For readings a frozen encoder takes its stored features [L, B, F] too; the memory may then have ``stored_size``.
        It is forgotten after a step where ``ended`` [L, B]; None for nowhere.
        """
        states = list(h_in.split([*self.splits, h_in.shape[1] - sum(self.splits)], 1))
        parts = []
        for index, (embed, x) in enumerate(zip(self.embedders, flat, strict=True)):
            y, states[index] = embed.unroll(x, states[index], ended)  # type: ignore[operator]
            parts.append(y)
        if self.tactile is not None and taxels is not None:
            mixed = self.precision is not None
            with torch.autocast(taxels.device.type, self.precision, cache_enabled=False) if mixed else nullcontext():
                y, states[-1] = self.tactile.unroll(taxels, states[-1], ended)
            parts.append(y.float() if mixed else y)
        return torch.cat(parts, -1), torch.cat([state.to(h_in.dtype) for state in states], 1)


class TactilePolicy(MLPModel):
    """A policy that feels; a drop-in for rsl_rl's models, with two more arguments.

    Args:
        tactile: Fields of :class:`~robotics_bridge.policies.encoders.arms.EncoderConfig`; needed where the set has
            touch.
        embedder: Encoder of flat groups: ``none``, ``mlp`` or ``lstm``.
    """

    is_recurrent: bool = True

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: tuple[int, ...] | list[int] = (512, 256, 128),
        activation: str = "elu",
        obs_normalization: bool = True,
        distribution_cfg: dict | None = None,
        *,
        tactile: Mapping[str, Any] | None = None,
        embedder: str = "mlp",
    ) -> None:
        names = list(obs_groups[obs_set])
        touch = TACTILE in names
        if touch and tactile is None:
            raise UsageError("The observations hold touch; name its encoder with tactile={'name': …}.")
        config = EncoderConfig.of(tactile) if touch and tactile is not None else None
        encoder = config.build() if config is not None else None
        if encoder is not None and tuple(obs[TACTILE].shape[1:]) != encoder.shape:
            raise UsageError(
                f"The tactile encoder for {encoder.config.observe}, {encoder.config.placement}, "
                f"{encoder.config.resolution} reads [sub-steps, items, channels] = {list(encoder.shape)}; the "
                f"environment gives {list(obs[TACTILE].shape[1:])}."
            )
        core = PolicyCore({name: obs[name].shape[-1] for name in names if name != TACTILE}, embedder, encoder)
        self._latent_size = core.features
        super().__init__(
            obs, obs_groups, obs_set, output_dim, hidden_dims, activation, obs_normalization, distribution_cfg
        )
        self.core: PolicyCore = core
        self.config: dict[str, Any] = {
            "tactile": asdict(config) if config is not None else None,
            "embedder": embedder,
            "hidden_dims": list(hidden_dims),
            "activation": activation,
            "obs_normalization": obs_normalization,
            "distribution_cfg": copy.deepcopy(distribution_cfg),
        }
        """Arguments that build it again."""
        self._state: torch.Tensor | None = None

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every group that it reads, per environment."""
        shapes: dict[str, tuple[int, ...]] = {k: (size,) for k, size in zip(self.obs_groups, self._sizes, strict=True)}
        if self.core.tactile is not None:
            shapes[TACTILE] = self.core.tactile.shape
        return shapes

    def advance(self, obs: Any, h_in: torch.Tensor) -> Stepped:
        """Return (latent [B, D], h_out [B, H]) of one step; :meth:`unroll` without L, not remembered in the model."""
        latents, h_out = self.unroll({name: obs[name][None] for name in self.shapes}, h_in)
        return latents[0], h_out

    def unroll(self, obs: Any, h_in: torch.Tensor, ended: torch.Tensor | None = None) -> Stepped:
        """Return (latents [L, B, D], h_out [B, H]) of groups [L, B, …] from a memory of zeros before the first step.

        It starts anew after a step where ``ended`` [L, B]. With features [L, B, F] of the frozen encoder as touch, in
        place of its readings, the memory is [B, ``core.stored_size``].
        """
        flat: list[torch.Tensor] = []
        if self.obs_groups:
            joined = torch.cat([obs[name] for name in self.obs_groups], -1)
            flat = list(self.obs_normalizer(joined).split(self._sizes, -1))
        return self.core.unroll(flat, obs[TACTILE] if self.core.tactile is not None else None, h_in, ended)

    def action_of(self, latent: torch.Tensor) -> torch.Tensor:
        """Return the deterministic actions [B, A] of a latent."""
        output = self.mlp(latent)
        return output if self.distribution is None else self.distribution.deterministic_output(output)

    def zeros(self, batch: int, *, stored: bool = False) -> torch.Tensor:
        """Return the memory [B, H] before the first step; that of ``unroll`` with features, if those are stored."""
        like = next(self.parameters())
        size = self.core.stored_size if stored else self.core.state_size
        return torch.zeros(batch, size, device=like.device, dtype=like.dtype)

    def get_latent(self, obs: Any, masks: torch.Tensor | None = None, hidden_state: Any = None) -> torch.Tensor:
        """Return the latent: of a step (the model remembers), or of padded sequences [T, B, …] when masks are given."""
        for norm in self._norms if self.training else ():
            # As observations, features are counted once for each step that was taken, after it was learned from: the
            # policy that learns is the one that acted, and padding counts for nothing.
            norm.held = norm.held or []
            norm.train(masks is None)
        if masks is None:
            if self._state is None:
                self._state = self.zeros(len(obs[next(iter(self.shapes))]))[None]
            latent, state = self.advance(obs, self._state[0])
            self._state = state[None]
            return latent
        if hidden_state is None:
            raise UsageError("Sequences need the hidden state in which they begin.")
        from rsl_rl.utils import unpad_trajectories

        latents, _ = self.unroll({name: obs[name] for name in self.shapes}, hidden_state[0])
        return unpad_trajectories(latents, masks)  # type: ignore[return-value]

    def reset(self, dones: torch.Tensor | None = None, hidden_state: Any = None) -> None:
        """Forget: all environments, or those that are done; or take a given memory [1, B, H]."""
        if dones is None:
            self._state = hidden_state
        elif self._state is not None:
            done = dones.view(-1).bool()
            self._state = torch.where(done[None, :, None], torch.zeros_like(self._state), self._state)

    def get_hidden_state(self) -> Any:
        """Return the memory [1, B, H]; zeros of one row before the first step of a model that was never run."""
        return self._state

    def detach_hidden_state(self, dones: torch.Tensor | None = None) -> None:
        """Cut the memory (of environments that are done) off the computation before."""
        if self._state is not None:
            cut = self._state.detach()
            self._state = cut if dones is None else torch.where(dones.view(1, -1, 1).bool(), cut, self._state)

    def update_normalization(self, obs: Any) -> None:
        """Take observations [..., B, …] into account in the normalisers; touch may be left out."""
        if self.obs_normalization and self.obs_groups:
            flat = torch.cat([obs[name].reshape(-1, obs[name].shape[-1]) for name in self.obs_groups], -1)
            normaliser: Any = self.obs_normalizer
            deviation = normaliser._std
            normaliser.update(flat)
            # rsl_rl puts a new tensor there, which a recorded graph would not see.
            normaliser._std = deviation.copy_(normaliser._std)
        touch = self.core.tactile
        # A frozen encoder has no scale to learn, and its features may stand in place of readings.
        if touch is not None and touch.frozen_part is None and TACTILE in obs.keys():  # noqa: SIM118 - a TensorDict
            touch.observe_scale(obs[TACTILE].reshape(-1, 1, *touch.shape))
        for norm in self._norms:
            norm.settle()

    @property
    def _norms(self) -> list[FeatureNorm]:
        return [part for part in self.core.modules() if isinstance(part, FeatureNorm)]

    def as_jit(self) -> nn.Module:
        """Raise UsageError: rsl_rl's own script would lose the encoder, and PyTorch ends TorchScript."""
        raise UsageError("This policy is no TorchScript; export it as ONNX: robotics_bridge.policies.export.")

    def as_onnx(self, verbose: bool = False) -> nn.Module:
        """Return a module of one step for ONNX: (group …, h_in) → (actions, h_out)."""
        return StepPolicy(self)

    def _get_obs_dim(self, obs: Any, obs_groups: dict[str, list[str]], obs_set: str) -> tuple[list[str], int]:
        names = [name for name in obs_groups[obs_set] if name != TACTILE]
        for name in names:
            if obs[name].ndim != 2:
                raise UsageError(f"The group {name!r} must be flat [B, n]; received {list(obs[name].shape)}.")
        # A list of numbers may stand before nn.Module is ready; modules may not.
        self._sizes = [int(obs[name].shape[1]) for name in names]
        return names, sum(self._sizes)

    def _get_latent_dim(self) -> int:
        return self._latent_size


class StepPolicy(nn.Module):
    """(group …, h_in [B, H]) → (actions [B, A], h_out [B, H]): a copy of the policy on the processor."""

    is_recurrent = True

    def __init__(self, policy: TactilePolicy) -> None:
        super().__init__()
        # What its distribution last drew, and what it remembers, hang on a graph and cannot be copied.
        sampled, without = policy.distribution, {id(part): None for part in (policy.distribution, policy._state)}
        self.policy: TactilePolicy = copy.deepcopy(policy, without).cpu().float().eval()  # type: ignore[arg-type]
        self.output: nn.Module = nn.Identity() if sampled is None else sampled.as_deterministic_output_module().cpu()
        self.input_names, self.output_names = [*policy.shapes, "h_in"], ["actions", "h_out"]

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions [B, A] and memory [B, H] of a control step; groups stand as in :attr:`input_names`."""
        latent, h_out = self.policy.advance(dict(zip(self.input_names, inputs, strict=True)), inputs[-1])
        return self.output(self.policy.mlp(latent)), h_out

    def get_dummy_inputs(self, batch: int = 1) -> tuple[torch.Tensor, ...]:
        """Return inputs [B, …] of zeros."""
        shapes = (*self.policy.shapes.values(), (self.policy.core.state_size,))
        return tuple(torch.zeros(batch, *shape) for shape in shapes)
