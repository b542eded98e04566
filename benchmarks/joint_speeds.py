"""How fast the joints turn while a planner drives them, as a share of their limit, apart from contacts.

python benchmarks/joint_speeds.py --out benchmarks/results/joint_speeds.json
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from torchdyn_plan.envs import TrapperEnv, TrapperScene, TrapperSimulation
from torchdyn_plan.evaluation.planners import PLANNERS
from torchdyn_plan.files import write_json
from torchdyn_plan.kinematics import UR5_LINKS, UR5_SPEED_LIMIT
from torchdyn_plan.versions import library_versions, machine

AFTERMATH = 50
"""Control steps after a contact that still count as contact: the arm swings out."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Watch joint speeds."""

    planner: str = "pursuit"
    """Planner for the moving target."""
    velocity: float = 3.0
    """[m/s]"""
    episodes: int = 1000
    """Number of episodes."""
    num_envs: int = 200
    """Episodes side by side."""
    out: Path | None = None
    """JSON file for the figures."""


class TouchedSimulation(TrapperSimulation):
    """A simulation that tells which arms a contact has pushed in any physics step of the last control step."""

    def __init__(self, num_envs: int, scene: TrapperScene) -> None:
        """Build the simulation as `TrapperSimulation` does."""
        super().__init__(num_envs, scene)
        self._first = int(self.model.joint(UR5_LINKS[0].joint).dofadr[0])
        self.touched = torch.zeros(num_envs, dtype=torch.bool)

    def step(self, action: Tensor | None = None, rows: Tensor | None = None) -> None:
        """One control step, a physics step at a time."""
        if action is not None:
            self._drive(action)
        self.touched = torch.zeros_like(self.touched)
        for _ in range(self.substeps):
            self.batch.step(None if rows is None else rows.numpy(), nstep=1)
            force = torch.from_numpy(self.batch.bind("qfrc_constraint"))
            self.touched |= (force[:, self._first : self._first + len(UR5_LINKS)] != 0).any(-1)


@torch.no_grad()
def main(arguments: Arguments) -> None:
    """Run, print and write."""
    torch.set_num_threads(1)
    env = TrapperEnv(arguments.num_envs, velocity=arguments.velocity, split="test")
    planner = PLANNERS[arguments.planner]("ik")
    env.simulation = simulation = TouchedSimulation(arguments.num_envs, env.scene)
    joints = len(UR5_LINKS)
    fastest, steps, above = torch.zeros(joints, dtype=torch.float64), 0, 0
    since = torch.full((arguments.num_envs,), AFTERMATH)
    state = env.reset()
    with tqdm(total=arguments.episodes, unit="episode") as bar:
        while bar.n < arguments.episodes:
            stepped, state = env.step_and_maybe_reset(planner(state))
            since = torch.where(simulation.touched, 0, since + 1)
            free = since > AFTERMATH
            share = stepped["next", "joint_vel"][free].double().abs() / UR5_SPEED_LIMIT
            if len(share):
                fastest = torch.maximum(fastest, share.amax(0))
                above += int(share.gt(1.02).any(dim=-1).sum())
            steps += len(share)
            bar.update(int(stepped["next", "done"].sum()))
    for link, value in zip(UR5_LINKS, fastest.tolist(), strict=True):
        print(f"{link.joint:14} {value:.3f} of the limit")
    print(f"{above} of {steps} steps outside contact above 1.02")
    if arguments.out is not None:
        row = {"fastest": fastest.tolist(), "free_steps": steps, "above_1.02": above}
        about = {"machine": machine(), "versions": library_versions(), "scene": env.scene.digest()}
        write_json(arguments.out, {"config": asdict(arguments) | {"out": str(arguments.out)}} | about | {"rows": [row]})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
