"""A path between parallel cushions, folded and unfolded: mirrored at each bounce, it becomes one continuous line."""

import torch
from torch import Tensor


def fold(unfolded: Tensor, half_extent: float) -> Tensor:
    """Coordinates on the table of a path that runs on through the cushions: the triangle wave of period 4L.

    Args:
        unfolded: ``(*B,)`` coordinates along one axis, any value [m].
        half_extent: L, where the path is mirrored: at -L and L [m].

    Returns:
        ``(*B,)`` coordinates within [-L, L] [m]; an odd function whose slope is 1 or -1 everywhere.
    """
    branch = torch.round(unfolded / (2 * half_extent))
    inside = unfolded - 2 * half_extent * branch
    return torch.where(branch % 2 == 0, inside, -inside)


def unfold(path: Tensor, half_extent: float, *, margin: float = 0.03, slowest: float = 2e-5) -> Tensor:
    """Inverse of `fold` along a path: the line that the target would follow if cushions were mirrors.

    A bounce is a reversal of one coordinate within ``margin`` of a cushion. Reversals elsewhere (the jaw of a pocket)
    stay in the line, and a coordinate beyond a cushion (a swallowed ball) counts as on it.

    Args:
        path: ``(*B, T, D)`` positions, one a step [m].
        half_extent: L, as in `fold` [m].
        margin: reversals farther than this from both cushions are no bounces [m].
        slowest: steps shorter than this have no direction [m].

    Returns:
        ``(*B, T, D)``, equal to the path until its first bounce [m].
    """
    path = path.clamp(-half_extent, half_extent)
    step = path.diff(dim=-2)
    heading = torch.where(step.abs() < slowest, 0.0, step.sign())
    middle = path[..., 1:-1, :]
    turned = (heading[..., :-1, :] * heading[..., 1:, :] < 0) & (middle.abs() > half_extent - margin)
    # Every second reversal happens on a mirrored branch, where the cushion on the right is met going left.
    mirrored = (turned.cumsum(-2) - turned.long()) % 2
    crossing = torch.where(turned, middle.sign() * (1 - 2 * mirrored), 0.0)
    branch = torch.nn.functional.pad(crossing.cumsum(-2), (0, 0, 2, 0))
    return torch.where(branch % 2 == 0, path, -path) + 2 * half_extent * branch
