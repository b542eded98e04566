"""Where should an arm stand? Gradients through inverse kinematics move its base until it reaches a set of goals.

Each step solves for all goals at once and follows the derivative of the solutions with respect to the base, which
the implicit function theorem gives: no step of the solver is differentiated.
"""

import torch
from torch import Tensor

from torchdyn_plan.kinematics import Arm, IKStatus, solve_ik

ARM = Arm.ur5(dtype=torch.float64)
HANG = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # the tool looks straight down
PLACES = torch.cartesian_prod(torch.linspace(0.9, 1.4, 4), torch.linspace(-0.5, 0.5, 5), torch.tensor([0.1, 0.3]))


def goals_from(base: Tensor) -> Tensor:
    """Poses of the goals, seen from a base at ``base`` (2,) [m] on the floor: ``(G, 4, 4)``."""
    target = HANG.repeat(len(PLACES), 1, 1)
    place = PLACES.to(base) - torch.cat([base, base.new_zeros(1)])
    return torch.cat([target[..., :3], torch.cat([place, torch.ones_like(place[:, :1])], dim=-1).unsqueeze(-1)], dim=-1)


def effort(base: Tensor) -> tuple[Tensor, Tensor]:
    """What is to be made small, and which goals are reached.

    A goal that is reached costs little, and more where its solution is nearly singular; one that is not costs by how
    far it is from where the arm works best, half a metre from its base.
    """
    target = goals_from(base)
    result = solve_ik(ARM, target, differentiable=True)
    reached = result.status == IKStatus.SOLVED
    jacobian = ARM.pose_and_jacobian(result.q)[1]
    nearly_singular = (torch.linalg.det(jacobian).square() + 1e-4).rsqrt()
    away = (target[:, :3, 3].norm(dim=-1) - 0.5).abs()
    return torch.where(reached, 0.003 * nearly_singular, 4.0 * away).mean(), reached


base = torch.zeros(2, dtype=torch.float64, requires_grad=True)
optimiser = torch.optim.Adam([base], lr=0.03)
for step in range(80):
    cost, reached = effort(base)
    if step % 5 == 0 or bool(reached.all()):
        print(
            f"step {step:2}: base {base[0]:.2f}, {base[1]:.2f} m, {int(reached.sum())} of {len(reached)} goals reached"
        )
    if bool(reached.all()):
        break
    optimiser.zero_grad()
    cost.backward()
    optimiser.step()
