"""Functions of columns, compiled into one loop over the rows of a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdyn_plan.checks import is_followed
from torchdyn_plan.errors import CompileError, InputError
from torchdyn_plan.kinematics.components import Component, Vector

if TYPE_CHECKING:
    from torchdyn_plan.kinematics.arm import Arm

Columns = tuple[Tensor, ...]


class Fused:
    """``function`` of columns as one compiled loop; it has no derivatives.

    It is compiled for each precision and device at its first call there, for any number of rows; torch keeps what it
    compiled in a cache on disk that other processes find. A row's result does not depend on its batch: the last rows
    of the loop are computed as the others are, by vector instructions under a mask.
    """

    def __init__(self, function: Callable[..., Sequence[Vector]]) -> None:
        """Take a function from tuples of columns ``(B,)``, one for each argument, to vectors of columns."""
        self.function = function
        self._compiled: dict[tuple[torch.device, torch.dtype], Callable[..., Sequence[Tensor]]] = {}

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """Rows ``(B, W)`` for each argument to rows for each result, which lie in memory column by column.

        Raises:
            CompileError: there is no compiler, or it failed.
            InputError: an argument requires a gradient.
        """
        if is_followed(*arguments):
            raise InputError("a compiled solve has no derivatives: detach its arguments, or leave compiled=False")
        columns = [in_columns(argument) for argument in arguments]
        key = columns[0].device, columns[0].dtype
        compiled = self._compiled.get(key)
        if compiled is None:
            compiled = self._compiled[key] = self._compile([argument.shape[1] for argument in arguments], *key)
        return [result.T for result in compiled(*columns)]

    def __getstate__(self) -> dict[str, Any]:
        """Without what was compiled, which belongs to this process."""
        return {"function": self.function, "_compiled": {}}

    def _compile(
        self, widths: Sequence[int], device: torch.device, dtype: torch.dtype
    ) -> Callable[..., Sequence[Tensor]]:
        from torch.fx.experimental.proxy_tensor import make_fx

        def stacked(*columns: Tensor) -> list[Tensor]:
            results = self.function(*(column.unbind(0) for column in columns))
            like = columns[0][0]
            return [torch.stack([filled(value, like) for value in vector]) for vector in results]

        example: list[Any] = [torch.zeros(width, 64, dtype=dtype, device=device) for width in widths]
        try:
            from torch._inductor import standalone_compile

            with torch.no_grad():
                graph = make_fx(stacked, tracing_mode="symbolic")(*example)
                # One loop whatever the size of the graph: its parts would pass their intermediates through memory.
                one_loop = {"config_patches": {"max_fusion_size": len(graph.graph.nodes) + 1}}
                compiled = standalone_compile(graph, example, dynamic_shapes="from_graph", options=one_loop)
                compiled(*example)
        except ImportError as error:
            raise CompileError("a compiled solve needs torch >= 2.8; leave compiled=False") from error
        except Exception as error:
            reason = str(error).strip().splitlines()
            raise CompileError(
                "the solve cannot be compiled; it needs a working C++ compiler (g++ or clang++ on the path, or the one "
                f"that CXX names). Leave compiled=False to do without. {reason[0] if reason else error!r}"
            ) from error
        return compiled


def in_columns(rows: Tensor) -> Tensor:
    """``rows`` (B, W) as columns ``(W, B)``, one after another in memory."""
    columns = rows.T
    # To stack columns takes half as long as `contiguous` does.
    return columns if columns.is_contiguous() else torch.stack(rows.unbind(1))


def filled(value: Component, like: Tensor) -> Tensor:
    """``value`` as a column like ``like``."""
    return value if isinstance(value, Tensor) else torch.full_like(like, value)


def compiled_pose_and_jacobian(arm: Arm) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """The arm's pose ``(B, 3, 4)``, without its last row, and Jacobian ``(B, 6, N)`` as one compiled loop."""

    def columns(joint_pos: Columns) -> tuple[Vector, Vector]:
        rotation, place, jacobian = arm.components(joint_pos)
        pose = [entry for row, end in zip(rotation, place, strict=True) for entry in (*row, end)]
        return pose, [entry for row in zip(*jacobian, strict=True) for entry in row]

    fused = Fused(columns)

    def pose_and_jacobian(joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        pose, jacobian = fused(joint_pos)
        return pose.unflatten(-1, (3, 4)), jacobian.unflatten(-1, (6, arm.num_joints))

    return pose_and_jacobian
