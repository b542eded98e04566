"""Every network that ships with the package, in every form, and what it reads: for tests of what all have in common."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchdyn_plan.nets import (
    Actor,
    CaptureNetwork,
    Critic,
    ETANetwork,
    Forecaster,
    PolicyConfig,
    SpreadForecaster,
    SpreadNetwork,
)


@dataclass(frozen=True)
class Kind:
    """A kind of network, in one of its forms."""

    make: Callable[[], nn.Module]
    inputs: Callable[[int], tuple[Tensor, ...]]
    """So many rows of what it reads, float32."""
    call: Callable[[Any, tuple[Tensor, ...]], tuple[Tensor, ...]]
    """Floating-point results of a network of this kind."""
    loss: float
    """Greatest median error of its first result by bfloat16 weights; by float16 an eighth of it."""


def histories(rows: int) -> tuple[Tensor]:
    """Balls that roll straight over a table, 24 positions at 4 ms."""
    draw = torch.Generator().manual_seed(rows)
    place, speed = torch.rand(2, rows, 1, 2, generator=draw) - 0.5
    level = place + 0.02 * speed * torch.arange(24.0).unsqueeze(-1)
    return (torch.cat([level, torch.full((rows, 24, 1), 0.025)], dim=-1),)


def open_histories(rows: int) -> tuple[Tensor]:
    """As `histories`, as short as another task's forecaster reads them."""
    return (histories(rows)[0][:, -reach().config.history :],)


def queries(rows: int) -> tuple[Tensor, Tensor]:
    """States of an arm and goals."""
    draw = torch.Generator().manual_seed(rows)
    state, goal = torch.rand(rows, 15, generator=draw) - 0.5, torch.rand(rows, 3, generator=draw) - 0.5
    return state, goal


def actor_inputs(rows: int) -> tuple[Tensor, ...]:
    return (*queries(rows), torch.rand(rows, 6, generator=torch.Generator().manual_seed(rows)) - 0.5)


def passings(rows: int) -> tuple[Tensor, Tensor]:
    """Stretches of path about goals, and the goals."""
    draw = torch.Generator().manual_seed(rows)
    goal, speed = torch.rand(2, rows, 1, 2, generator=draw) - 0.5
    steps = torch.arange(-16.0, 17.0, 2.0).unsqueeze(-1)
    return goal + 0.03 * speed * steps, goal.squeeze(-2)


def stretches(rows: int) -> tuple[Tensor, Tensor]:
    """Whole paths that pass goals after 40 control steps, and the goals."""
    window, goal = passings(rows)
    speed = (window[:, 1:2] - window[:, :1]) / 2.0
    return goal.unsqueeze(1) + speed * torch.arange(-40.0, 41.0).unsqueeze(-1), goal


def captured(network: Any, seen: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    path, goal = seen
    return (network.probability(path, goal.unsqueeze(-2), torch.tensor([40])),)


def spread_forecaster() -> SpreadForecaster:
    return SpreadForecaster(Forecaster.from_pretrained("trapper"), SpreadNetwork.from_pretrained("trapper"))


def actor() -> Actor:
    return Actor.from_pretrained("trapper")


def critic() -> Critic:
    torch.manual_seed(0)
    return Critic(PolicyConfig())


def forecast(network: Any, seen: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    found = network.predict(*seen)
    return (found.path, *(found.spread or ()))


def describe(network: Any, seen: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return network.describe(*seen)[:2]


def arrival(network: Any, seen: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    found = network.arrival(*seen, estimator="distribution")
    return found.steps, found.bins


def from_state(network: Any, seen: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return (network.from_state(seen[0])(seen[1].unsqueeze(-2), estimator="expectation").steps.squeeze(-1),)


def directly(network: Any, seen: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return (network(*seen),)


def reach() -> Forecaster:
    return Forecaster.from_pretrained("fetch_reach")


def forecaster() -> Forecaster:
    return Forecaster.from_pretrained("trapper")


def eta() -> ETANetwork:
    return ETANetwork.from_pretrained("trapper-ik")


def capture() -> CaptureNetwork:
    return CaptureNetwork.from_pretrained("trapper-ik")


KINDS = {
    "forecaster": Kind(forecaster, histories, directly, 2e-4),
    "forecaster in open space": Kind(reach, open_histories, directly, 1e-3),
    "description": Kind(forecaster, histories, describe, 2e-4),
    "spread": Kind(spread_forecaster, histories, forecast, 2e-4),
    "eta": Kind(eta, queries, directly, 1.0),
    "arrival": Kind(eta, queries, arrival, 1e-3),
    "arrival from a state": Kind(eta, queries, from_state, 1e-3),
    "capture": Kind(capture, passings, directly, 0.1),
    "capture for inference": Kind(lambda: capture().for_inference(), stretches, captured, 1e-6),
    "actor": Kind(actor, queries, directly, 5e-3),
    "critic": Kind(critic, actor_inputs, directly, 5e-3),
    "forecaster for inference": Kind(lambda: forecaster().for_inference(), histories, directly, 1e-6),
    "open forecaster for inference": Kind(lambda: reach().for_inference(), open_histories, directly, 1e-6),
    "spread for inference": Kind(lambda: spread_forecaster().for_inference(), histories, forecast, 1e-6),
    "eta for inference": Kind(lambda: eta().for_inference(), queries, directly, 1e-3),
    "arrival for inference": Kind(lambda: eta().for_inference(), queries, arrival, 1e-6),
    "arrival from a state for inference": Kind(lambda: eta().for_inference(), queries, from_state, 1e-6),
}
