"""What the future of an environment batch depends on, as named tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from brainbench.core.devices import warp

if TYPE_CHECKING:
    import torch

    from robotics_bridge.envs.env import Env

_OWN = (
    "action", "last_action", "episode_length_buf", "_steps", "_return", "metric", "friction", "mass", "_push_left",
    "_start_joints", "_start_position", "_home", "_sums", "_totals", "target",
)  # fmt: skip


def saved(env: Env) -> dict[str, torch.Tensor]:
    """Return copies of all memory of an environment batch, but for that of noisy or slow tactile sensors."""
    own = {name: getattr(env, name).clone() for name in _OWN}
    own["generator"] = env._generator.get_state()
    for part, source in _parts(env).items():
        own |= {f"{part}.{name}": value for name, value in source.state_dict().items()}
    own |= {name: value.clone() for name, value in _touch(env).items()}
    return own | {f"observations.{name}": value.clone() for name, value in env.observations.items()}


def restore(env: Env, values: Mapping[str, torch.Tensor]) -> None:
    """Put an environment batch where :func:`saved` found one."""

    def under(part: str) -> dict[str, Any]:
        return {name[len(part) + 1 :]: value for name, value in values.items() if name.startswith(f"{part}.")}

    for name in _OWN:
        getattr(env, name).copy_(values[name])
    env._generator.set_state(values["generator"].cpu())
    for part, source in _parts(env).items():
        source.load_state_dict(under(part))
    for name, value in _touch(env).items():
        value.copy_(values[name])
    env._resets.first = False
    env.observations = {name: value.to(env.device) for name, value in under("observations").items()}


def _parts(env: Env) -> dict[str, Any]:
    parts: dict[str, Any] = {"world": env.world, "drives": env.drives, "goals": env.goals, "contacts": env.contacts}
    return parts if env.watch is None else {**parts, "watch": env.watch}


def _touch(env: Env) -> dict[str, torch.Tensor]:
    if env.touch is None:
        return {}
    clock, wp = env.touch.suite.clock, warp()
    return {
        "touch.reading": env.touch.reading,
        "touch.age": wp.to_torch(clock.age),
        "touch.episode": wp.to_torch(clock.episode),
    }
