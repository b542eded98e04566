"""What a better forecast gains: the meeting planner as it is, cautious, adaptive, both, and with the truth foretold.

The truth is simulated on from the ball as it is, touched or not, with its own friction. Every planner plays the same
episodes, so that differences to the first are paired.

    python benchmarks/forecast_gain.py --velocity 3 --friction 9.5 --out benchmarks/results/forecast_gain.json
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor, nn

from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapper import TrapperEnv
from torchdyn_plan.evaluation.planners import CHUNK, static_planner
from torchdyn_plan.evaluation.run import EpisodeLog, record_truth
from torchdyn_plan.files import write_json
from torchdyn_plan.planners import Adaptation, MeetingPlanner
from torchdyn_plan.planners.meeting import CAUTIOUS
from torchdyn_plan.versions import library_versions, machine

BALL_STATE = "ball_state"


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Play the same episodes with each planner."""

    velocity: float = 3.0
    """[m/s]"""
    friction: float = 0.0
    """[N]"""
    episodes: int = 300
    """Episodes of each series."""
    seeds: tuple[int, ...] = (1, 2)
    """Series of the dev split."""
    planners: tuple[str, ...] = ("meet", "cautious", "adaptive", "both", "truth")
    """The first is what the others are compared to."""
    out: Path | None = None
    """JSON file for the figures."""


class Foretold(nn.Module):
    """Stands in for a forecaster and tells how the ball will roll on from its present state if nothing touches it."""

    in_keys = (BALL_STATE,)

    def __init__(self, friction: float, horizon: int = 300) -> None:
        super().__init__()
        self.horizon = horizon
        self.simulation = TrapperSimulation(CHUNK, TrapperScene(), friction=friction, num_threads=1, arm=False)

    def forward(self, state: Tensor) -> Tensor:
        """Positions ``(R, F, 3)`` [m, world] after states ``(R, 13)``: place, turn, velocity, spin; R = `CHUNK`."""
        simulation = self.simulation
        simulation.reset(torch.arange(CHUNK), state[:, :2], state[:, 7:9])
        place, turn, velocity, spin = state.split((3, 4, 3, 3), dim=-1)
        simulation.ball_pos[:], simulation._ball_turn[:] = place, turn
        simulation.ball_vel[:], simulation.ball_spin[:] = velocity, spin
        path = torch.empty(CHUNK, self.horizon, 3)
        for step in range(self.horizon):
            simulation.step()
            path[:, step] = simulation.ball_pos
        return path


def planners(friction: float) -> dict[str, Callable[[], MeetingPlanner]]:
    """Each planner by name, built when it is asked for."""

    def learned(**settings: Any) -> MeetingPlanner:
        planner = MeetingPlanner.from_pretrained("trapper-ik", chunk=CHUNK, **settings)
        planner.static = static_planner("ik")
        return planner

    def foretold() -> MeetingPlanner:
        planner = learned()
        return MeetingPlanner(planner.static, Foretold(friction), planner.eta, chunk=CHUNK).eval()

    return {
        "meet": learned,
        "cautious": lambda: learned(search=CAUTIOUS),
        "adaptive": lambda: learned(adaptation=Adaptation()),
        "both": lambda: learned(search=CAUTIOUS, adaptation=Adaptation()),
        "truth": foretold,
    }


@torch.no_grad()
def trapped(planner: MeetingPlanner, setting: EvaluateArguments) -> Tensor:
    """Which episodes end with the ball trapped, ``(E,)`` bool."""
    env = TrapperEnv(
        setting.num_envs, velocity=setting.velocity, friction=setting.friction, seed=setting.seed, split=setting.split,
        num_threads=1,
    )  # fmt: skip
    log, tensordict, simulation = EpisodeLog.empty(setting.episodes), env.reset(), env.simulation
    foretells = BALL_STATE in planner.in_keys
    while not log.done.all():
        if foretells:
            parts = (simulation.ball_pos, simulation._ball_turn, simulation.ball_vel, simulation.ball_spin)
            tensordict[BALL_STATE] = torch.cat(parts, dim=-1)
        stepped, tensordict = env.step_and_maybe_reset(planner(tensordict))
        log.add(stepped)
    return log.trapped


def main(arguments: Arguments) -> None:
    """Run, print and write."""
    torch.set_num_threads(1)
    makers = planners(arguments.friction)
    settings = [
        EvaluateArguments(
            velocity=arguments.velocity,
            friction=arguments.friction,
            episodes=arguments.episodes,
            seed=seed,
            split="dev",
            num_envs=min(arguments.episodes, 300),
            threads=1,
        )
        for seed in arguments.seeds
    ]
    solvable = torch.cat([record_truth(setting)[1] for setting in settings])
    rows: list[dict[str, Any]] = []
    first = None
    for name in arguments.planners:
        caught = torch.cat([trapped(makers[name](), setting) for setting in settings])[solvable].double()
        first = caught if first is None else first
        gain = caught - first
        row = {"planner": name, "velocity": arguments.velocity, "friction": arguments.friction, "split": "dev"}
        row |= {"solvable": len(caught), "success_solvable": caught.mean().item(), "gain": gain.mean().item()}
        row["gain_half_width_95"] = 1.96 * gain.std().item() / len(gain) ** 0.5
        print("  ".join(f"{key} {value:.4g}" if isinstance(value, float) else str(value) for key, value in row.items()))
        rows.append(row)
    if arguments.out is not None:
        about = {"machine": machine(), "versions": library_versions(), "scene": TrapperScene().digest()}
        write_json(arguments.out, {"config": asdict(arguments) | {"out": str(arguments.out)}} | about | {"rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
