"""Environments of this package by Gymnasium's conventions, for libraries that speak no tensordict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.moving_target import RENDER_MODES, MovingTargetEnv
from torchdyn_plan.errors import InputError

Shown = Any
"""An array, or arrays by name, as the observation space says."""
Array = np.ndarray[Any, Any]


@dataclass(frozen=True, kw_only=True)
class GymForm:
    """How a world is shown to Gymnasium."""

    make: Callable[..., MovingTargetEnv]
    """Makes the world from ``num_envs`` and its settings."""
    show: Callable[[TensorDictBase], Tensor | dict[str, Tensor]]
    """What is observed, ``(N, …)``, of what the world shows."""
    reward: Callable[[Any, Tensor, Tensor], Tensor] | None = None
    """Rewards (*B,) in a world, of achieved goals (*B, G) for desired goals (*B, G); None where they take more."""
    fps: int
    """Actions a second."""


class _Gym:
    """What one environment and many side by side share: a world, and the form in which it is shown."""

    def _build(self, form: str | GymForm, num_envs: int, render_mode: str | None, settings: dict[str, Any]) -> None:
        self.form = form if isinstance(form, GymForm) else _load(form)
        self.world = self.form.make(num_envs, render_mode=render_mode, **settings)
        self.render_mode = render_mode

    def _seed(self, seed: Any) -> None:
        if seed is not None:
            check_number("seed", seed, minimum=0, integer=True)
            self.world.set_seed(int(seed), static_seed=True)

    def _acted(self, action: Any) -> TensorDict:
        """``action`` of all environments (N, A) as the world reads it."""
        rows = torch.as_tensor(np.asarray(action), dtype=torch.float32)
        return TensorDict({keys.ACTION: rows}, batch_size=self.world.batch_size)

    def _arrays(self, seen: TensorDictBase) -> Shown:
        shown = self.form.show(seen)
        if isinstance(shown, Tensor):
            return shown.numpy()
        return {name: value.numpy() for name, value in shown.items()}

    def _is_success(self, seen: TensorDictBase) -> Array:
        return np.asarray(seen[self.world.flags[0]].squeeze(-1))

    def _spaces(self) -> tuple[Space[Any], Space[Any]]:
        """Observation and action spaces of one environment."""
        shown = self.form.show(self.world.observation_spec.zero())
        single: Space[Any] = (
            Box(-np.inf, np.inf, tuple(shown.shape[1:]))
            if isinstance(shown, Tensor)
            else Dict({name: Box(-np.inf, np.inf, tuple(value.shape[1:])) for name, value in shown.items()})
        )
        return single, Box(-1.0, 1.0, tuple(self.world.action_spec.shape[1:]))


class GymEnv(_Gym, gymnasium.Env[Shown, Array], EzPickle):
    """One episode after the other of a `MovingTargetEnv`.

    ``info`` has ``is_success``. Without a seed, copies play different episodes; a copy that was pickled starts a
    series of its own.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012  # As Gymnasium declares it.

    def __init__(self, form: str | GymForm, *, render_mode: str | None = None, **settings: Any) -> None:
        """Build a world of one environment.

        Args:
            form: how it is shown, or where that stands: ``module:NAME``.
            render_mode: ``rgb_array`` for pictures by `render`.
            **settings: of the world.
        """
        EzPickle.__init__(self, form, render_mode=render_mode, **settings)
        self._build(form, 1, render_mode, settings)
        self.metadata = self.metadata | {"render_fps": self.form.fps}
        self.observation_space, self.action_space = self._spaces()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Shown, dict[str, Any]]:
        """Start the next episode, or the first one of the series ``seed``."""
        super().reset(seed=seed)
        self._seed(seed)
        seen = self.world.reset()
        return self._first(self._arrays(seen)), {"is_success": bool(self._is_success(seen)[0])}

    def step(self, action: Array) -> tuple[Shown, float, bool, bool, dict[str, Any]]:
        """Act by ``action`` (A,), each entry -1 to 1."""
        after = self.world.step(self._acted(np.asarray(action)[None]))["next"]
        about = {"is_success": bool(self._is_success(after)[0])}
        terminated, truncated = bool(after["terminated"]), bool(after["truncated"])
        return self._first(self._arrays(after)), float(after["reward"]), terminated, truncated, about

    def render(self) -> Any:
        """A picture ``(height, width, 3)`` uint8; None without a render mode."""
        return None if self.render_mode is None else self.world.render(row=0)

    def close(self) -> None:
        """End the world."""
        self.world.close()

    @staticmethod
    def _first(shown: Shown) -> Shown:
        return {name: value[0] for name, value in shown.items()} if isinstance(shown, dict) else shown[0]


class GoalGymEnv(GymEnv):
    """The same in a world of goals: observations have an achieved and a desired one, of which the reward is a function.

    Libraries of hindsight know such an environment by its `compute_reward`.
    """

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Array:
        """Rewards (*B,) of ``achieved_goal`` (*B, G) for ``desired_goal`` (*B, G), whatever ``info``."""
        assert self.form.reward is not None
        achieved, desired = (torch.as_tensor(value, dtype=torch.float32) for value in (achieved_goal, desired_goal))
        return np.asarray(self.form.reward(self.world, achieved, desired))

    def _build(self, form: str | GymForm, num_envs: int, render_mode: str | None, settings: dict[str, Any]) -> None:
        super()._build(form, num_envs, render_mode, settings)
        if self.form.reward is None:
            raise InputError("a GoalGymEnv needs a form with a reward, got one without")


class GymVectorEnv(_Gym, VectorEnv[Shown, Array, Array]):
    """Many environments side by side in one batched simulation.

    An environment whose episode ends starts its next one in the same step: what is returned is of the new episode, and
    ``final_obs`` and ``final_info`` of ``infos`` hold what the old one ended with.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # As Gymnasium declares it.
        "render_modes": list(RENDER_MODES),
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self, form: str | GymForm, num_envs: int = 1, *, render_mode: str | None = None, **settings: Any
    ) -> None:
        """Build a world of ``num_envs`` environments; arguments as of `GymEnv`."""
        self._build(form, num_envs, render_mode, settings)
        self.num_envs = num_envs
        self.metadata = self.metadata | {"render_fps": self.form.fps}
        self.single_observation_space, self.single_action_space = self._spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Shown, dict[str, Any]]:
        """Start the next episodes, or the first ones of the series ``seed``, one number for all environments."""
        self._seed(seed)
        seen = self.world.reset()
        return self._arrays(seen), self._about(seen)

    def step(self, actions: Array) -> tuple[Shown, Array, Array, Array, dict[str, Any]]:
        """Act by ``actions`` (N, A)."""
        stepped, state = self.world.step_and_maybe_reset(self._acted(actions))
        after = stepped["next"]
        reward, terminated, truncated, done = map(self._column(after), ("reward", "terminated", "truncated", "done"))
        infos = self._about(after)
        if done.any():
            infos |= {"final_obs": self._rows(self._arrays(after), done), "_final_obs": done.copy()}
            infos |= {"final_info": self._about(after), "_final_info": done.copy()}
        return self._arrays(state), reward, terminated, truncated, infos

    def render(self) -> Any:
        """A picture ``(height, width, 3)`` uint8 of each environment; None without a render mode."""
        return None if self.render_mode is None else tuple(self.world.render())

    def close_extras(self, **_: Any) -> None:
        """End the world."""
        self.world.close()

    @staticmethod
    def _column(seen: TensorDictBase) -> Callable[[str], Array]:
        """Entries (N, 1) of ``seen`` by their name, as ``(N,)``."""
        return lambda name: np.asarray(seen[name].squeeze(-1))

    def _about(self, seen: TensorDictBase) -> dict[str, Any]:
        return {"is_success": self._is_success(seen), "_is_success": np.ones(self.num_envs, dtype=np.bool_)}

    def _rows(self, shown: Shown, chosen: Array) -> Array:
        """What each of the ``chosen`` (N,) environments shows, as Gymnasium's own vectors have it: objects, or None."""
        rows = np.full(self.num_envs, None, dtype=object)
        for row in chosen.nonzero()[0]:
            rows[row] = {name: value[row] for name, value in shown.items()} if isinstance(shown, dict) else shown[row]
        return rows


def _load(place: str) -> GymForm:
    module, _, name = place.partition(":")
    form = getattr(import_module(module), name, None) if name else None
    if not isinstance(form, GymForm):
        raise InputError(f"form must be a GymForm or the place of one, module:NAME, got {place!r}")
    return form
