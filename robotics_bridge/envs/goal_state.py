"""The goals of a batch of environments and how far each object is from its own. Letters: B environment."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from brainbench.core.rotations import angle_of, conjugate, multiply, rotate, twist_and_swing, twist_of
from robotics_bridge.tasks.task import Task


class GoalState:
    """Buffers of goals, of rotation since the start, and of what happened in the last step.

    ``round_about`` [B, 3] are the axes of the objects about which a turn does not show, zero for those without.
    """

    def __init__(self, task: Task, num_envs: int, device: torch.device, round_about: torch.Tensor) -> None:
        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(num_envs, *shape, dtype=dtype, device=device)

        self.goal, self._dt = task.goal, task.step_dt
        self._round_about = round_about if self.goal is not None and self.goal.by_looks else None
        self._least = 0.0 if task.goal is None else task.goal.threshold
        self.threshold = torch.full((), self._least, device=device)
        """Angle [] below which a goal counts as reached now (rad)."""
        self._won = task.success.threshold if task.success.metric == "goals" else 1.0
        self._tally = torch.zeros(2, device=device)
        """[2] episodes that ended since the threshold was last judged, and successful ones among them."""
        self.quat, self.previous = zeros(4), zeros(4)
        self.quat[:, 0] = self.previous[:, 0] = 1.0
        """Goal, and orientation one step before [B, 4] (w, x, y, z)."""
        self.angle, self.angle_before, self.left = zeros(), zeros(), zeros()
        self.reached, self.missed = zeros(dtype=torch.bool), zeros(dtype=torch.bool)
        self.count, self.rate, self.off_axis, self.turned = zeros(), zeros(), zeros(), zeros()
        self.turned_held = zeros()
        """Rotation [B] about the commanded axis of this episode while anything touched the object (rad)."""
        self.allowed_off_axis = float(getattr(task.goal, "allowed_off_axis", float("inf")))
        self._axis = None
        if self.goal is not None and self.goal.axis is not None:
            self._axis = nn.functional.normalize(torch.tensor(self.goal.axis, device=device), dim=0)
        self._turn = None if task.turn_axis is None else torch.tensor(task.turn_axis, device=device)
        window = task.turn_window if self._turn is not None else 1
        self._ring = torch.full((window, num_envs), float("inf"), device=device)
        self._step = torch.zeros(1, dtype=torch.long, device=device)
        self.turned_before = torch.full((num_envs,), float("inf"), device=device)

    def reset(self, mask: torch.Tensor, quat: torch.Tensor, draw: Any) -> None:
        """Start new episodes in some environments [B] bool, whose objects have orientations ``quat`` [B, 4]."""
        self.previous.copy_(torch.where(mask.unsqueeze(1), quat, self.previous))
        for name in ("count", "rate", "off_axis", "turned", "turned_held"):
            getattr(self, name).masked_fill_(mask, 0.0)
        for name in ("reached", "missed"):
            getattr(self, name).masked_fill_(mask, value=False)
        self._ring.masked_fill_(mask, float("inf"))
        if self.goal is not None:
            self._set(mask, self.goal.first(quat, draw(2, 0.0, 1.0)), quat, draw)

    def looks(self, quat: torch.Tensor) -> torch.Tensor:
        """Return the orientations [B, 4] nearest to the goals in which the objects look as in ``quat`` [B, 4]."""
        if self._round_about is None:
            return quat
        return multiply(quat, twist_of(multiply(conjugate(quat), self.quat), self._round_about))

    def update(self, quat: torch.Tensor, held: torch.Tensor) -> None:
        """Judge the orientations [B, 4] after a control step, in which objects [B] bool were touched or not."""
        step = multiply(quat, conjugate(self.previous))
        self.previous.copy_(quat)
        if self._turn is not None:
            twist, _ = twist_and_swing(step, rotate(quat, self._turn))
            self.turned += twist
            if self._axis is None:
                # Where a goal commands an axis, rotation about that one is counted, below.
                self.turned_held += twist * held
            place = self._step % self._ring.shape[0]
            self.turned_before.copy_(self._ring.index_select(0, place)[0])
            self._ring.index_copy_(0, place, self.turned.unsqueeze(0))
            self._step += 1
        if self.goal is None:
            return
        error = multiply(self.quat, conjugate(self.looks(quat)))
        self.angle_before.copy_(self.angle)
        self.angle.copy_(angle_of(error))
        if self._axis is not None:
            # Rotation of the last step split into twist about the commanded axis and the swing across it.
            twist, _ = twist_and_swing(step, self._axis)
            self.rate.copy_(twist / self._dt)
            self.turned_held += twist * held
            _, swing = twist_and_swing(error, self._axis)
            self.off_axis.copy_(swing)
        self.left -= self._dt
        self.reached.copy_(self.angle < self.threshold)
        self.missed.copy_((self.left <= 0) & ~self.reached)
        self.count += self.reached

    def start_curriculum(self) -> None:
        """Start the curriculum of a goal that has one: from now on its threshold is wide and narrows."""
        if self.goal is not None and self.goal.start_threshold is not None:
            self.threshold.fill_(self.goal.start_threshold)
            self._tally.zero_()

    def count_episodes(self, done: torch.Tensor) -> None:
        """Count the episodes that end [B] bool, and narrow the threshold when enough of them succeeded."""
        if self.goal is None or self.goal.start_threshold is None:
            return
        won = done & (self.count >= self._won)
        self._tally += torch.stack((done.sum(), won.sum()))
        full = self._tally[0] >= len(done)
        # Decided on the device, without the host waiting for the count: recorded graphs cannot branch.
        narrow = full & (self._tally[1] > self.goal.mastered * self._tally[0])
        closer = (self.threshold * self.goal.narrowing).clamp(min=self._least)
        self.threshold.copy_(torch.where(narrow, closer, self.threshold))
        self._tally.masked_fill_(full, 0.0)

    def curriculum(self) -> dict[str, torch.Tensor]:
        """Return what remembers how far the curriculum went; nothing without one."""
        if self.goal is None or self.goal.start_threshold is None:
            return {}
        return {"threshold": self.threshold, "tally": self._tally}

    def advance(self, quat: torch.Tensor, draw: Any) -> None:
        """Propose the next goals where the present ones are reached or their time is up."""
        if self.goal is not None:
            following = self.goal.following(quat, self.quat, draw(2, 0.0, 1.0))
            self._set(self.reached | self.missed, following, quat, draw)

    def _set(self, mask: torch.Tensor, goal: torch.Tensor, quat: torch.Tensor, draw: Any) -> None:
        self.quat.copy_(torch.where(mask.unsqueeze(1), goal, self.quat))
        angle = angle_of(multiply(self.quat, conjugate(self.looks(quat))))
        self.angle.copy_(torch.where(mask, angle, self.angle))
        deadline = None if self.goal is None else self.goal.deadline
        if deadline is None:
            self.left.fill_(float("inf"))
        else:
            self.left.copy_(torch.where(mask, draw(1, *deadline)[:, 0], self.left))

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves that later steps depend on, by name."""
        names = ("quat", "previous", "angle", "angle_before", "left", "reached", "missed", "count", "rate", "off_axis")
        own = {name: getattr(self, name) for name in (*names, "turned", "turned_held")}
        return {**own, "ring": self._ring, "step": self._step[0], **self.curriculum()}
