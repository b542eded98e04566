"""Which resting balls the arm can be over, and which it can cover."""

import torch

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.tasks.trapper.workspace import is_coverable, is_reachable

SCENE = TrapperScene()


def test_the_box_covers_balls_that_it_cannot_stand_in_the_middle_over():
    # Balls ever farther from the arm's base, which stands behind the middle of a wall.
    away = torch.linspace(0.84, 1.0, 17, dtype=torch.float64)
    place = torch.stack([torch.zeros(17, dtype=torch.float64), SCENE.base_pos[1] + away], dim=-1)
    reachable, coverable = is_reachable(SCENE, place), is_coverable(SCENE, place)
    assert reachable[0]
    assert not coverable[-1]
    assert bool((coverable | ~reachable).all()), "every ball within reach can be covered"
    # Off its middle it reaches as far again as it leaves the ball room: two centimetres.
    gained = (coverable & ~reachable).nonzero().flatten().tolist()
    assert 1 <= len(gained) <= 3
