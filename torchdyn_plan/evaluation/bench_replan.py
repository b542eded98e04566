"""Latency and throughput of a re-plan, of its parts, and of a whole planner step around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.play import one_thread
from torchdyn_plan.evaluation.replan_parts import Inputs, Part, in_blocks, networks, replans, searches, steps
from torchdyn_plan.evaluation.timing import figures, sample
from torchdyn_plan.planners import DynamicPlanner, IKPlanner, MeetingPlanner

BATCHES = (1, 16, 256, 1024, 4096, 16384)
"""Rows that plan at once."""
BLOCK = 1024
"""Rows that are worked on at a time on a processor, if there are more."""
SINGLES = 16
"""Rows of a batch that are compared with the same rows computed one by one."""
FIRST_PLAN = 13
"""Control step of the first plan."""
COMPILED: dict[str, dict[str, Any]] = {"cpu": {"options": {"cpp_wrapper": True}}, "cuda": {"mode": "reduce-overhead"}}
"""How `torch.compile` is asked for little work around the kernels: calls from C++, or CUDA graphs."""
TRAINED, FOLDED = "torchdyn_plan", "torchdyn_plan, folded"
"""Implementations: the networks as they are trained, and their copies for inference."""


def bench(
    planner: DynamicPlanner | None = None,
    meeting: MeetingPlanner | None = None,
    *,
    batches: Sequence[int] = BATCHES,
    seconds: float = 0.4,
    compiled: bool = True,
) -> list[dict[str, Any]]:
    """A row for each device, batch, part and implementation.

    A row has the latency's median, 95th and 99th percentile, the throughput ``per_second``, and ``max_error``: the
    greatest difference from the same rows one by one, eager and with the networks as they are trained. A meeting may
    differ much where two are as good: rounding decides.

    Args:
        planner: an `IKPlanner` made to meet a moving target by networks; the one that ships by default.
        meeting: the same that waits and drops; the one that ships by default.
        batches: rows that plan at once.
        seconds: time spent on each figure.
        compiled: also measure re-plans and networks compiled; each takes up to three compilations of a minute or less.
    """
    from tqdm import tqdm

    planner = planner or DynamicPlanner.from_pretrained("trapper-ik")
    meeting = meeting or MeetingPlanner.from_pretrained("trapper-ik")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = []
    several = torch._dynamo.config.patch(recompile_limit=64)  # The forms share code, and count together.
    with one_thread(), torch.no_grad(), several, tqdm(desc="re-plan", unit="figure", leave=False) as bar:
        for device in devices:
            forms = _forms(planner.to(device), meeting.to(device), device, compiled=compiled)
            for batch in batches:
                seen = observations(batch).to(device)
                seen.set(keys.PLAN, planner(seen.copy())[keys.PLAN])
                for form in forms:
                    bar.set_postfix_str(f"{device}, batch {batch}, {form[0]['what']}")
                    rows.append(_row(form, seen, device, seconds))
                    bar.update()
    planner.to("cpu")
    meeting.to("cpu")
    return rows


Form = tuple[dict[str, Any], Part, Part, Inputs]
"""What a row is about, what is timed, what it is compared with, and what both read."""


def _forms(planner: DynamicPlanner, meeting: MeetingPlanner, device: str, *, compiled: bool) -> list[Form]:
    """Everything that is timed on ``device``."""
    pairs = (planner, meeting), (planner.folded(), meeting.folded())
    plain, folded = ({**networks(one), **replans(one, other)} for one, other in pairs)
    forms: list[Form] = []

    def add(parts: dict[str, tuple[Part, Inputs]], implementation: str, change: Callable[[Part], Part] | None) -> None:
        for what, (part, inputs) in parts.items():
            about = {"what": what, "implementation": implementation, "compiled": change is not None}
            reference = plain.get(what, (part, inputs))[0]
            forms.append((about, part if change is None else change(part), reference, inputs))

    add(plain | searches() | steps(planner), TRAINED, None)
    add(folded, FOLDED, None)
    if compiled:
        change: Any = partial(torch.compile, fullgraph=True, **COMPILED[device])
        add(folded, FOLDED, change)
    return forms


def _row(form: Form, seen: TensorDictBase, device: str, seconds: float) -> dict[str, Any]:
    about, part, reference, inputs = form
    batch, read = len(seen), inputs(seen)
    timed = partial(in_blocks, part, BLOCK) if device == "cpu" else part
    found = figures(sample(lambda: timed(*read), device=device, seconds=seconds), batch)
    place = {"batch": batch, "threads": torch.get_num_threads(), "device": device}
    error = _error(lambda one: timed(*inputs(one)), lambda one: reference(*inputs(one)), seen)
    return about | place | found | {"per_second": round(1e6 / found["per_item_us"]), "max_error": error}


def _error(
    part: Callable[[TensorDictBase], Sequence[Tensor]],
    reference: Callable[[TensorDictBase], Sequence[Tensor]],
    seen: TensorDictBase,
) -> float:
    """Greatest difference between the first rows of a batch and what ``reference`` makes of them one by one."""
    singles = [reference(seen[row : row + 1]) for row in range(min(SINGLES, len(seen)))]
    pairs = zip(part(seen), map(torch.cat, zip(*singles, strict=True)), strict=True)
    return max(float((whole[: len(single)].double() - single.double()).abs().max()) for whole, single in pairs)


def observations(batch: int) -> TensorDict:
    """What a planner sees of ``batch`` arms near home and balls that roll straight at 1 to 5 m/s, at the first plan."""
    scene, random = TrapperScene(), torch.Generator().manual_seed(0)
    static = IKPlanner()
    joint_pos = torch.tensor(scene.home) + 0.2 * torch.randn(batch, 6, generator=random)
    joint_vel = 0.5 * torch.randn(batch, 6, generator=random)
    tool_pos = static.arm(joint_pos)[:, :3, 3] + torch.tensor(scene.base_pos)
    speed = 1.0 + 4.0 * torch.rand(batch, 1, generator=random)
    angle = 2 * torch.pi * torch.rand(batch, 1, generator=random)
    velocity = speed * torch.cat([angle.cos(), angle.sin(), torch.zeros(batch, 1)], dim=-1)
    target = 0.5 * scene.half_side * (2.0 * torch.rand(batch, 1, 3, generator=random) - 1.0)
    target[..., 2] = scene.ball_radius
    past = scene.control_step * torch.arange(-23.0, 1.0).clamp_min(-FIRST_PLAN).unsqueeze(-1)
    history = target + velocity.unsqueeze(1) * past
    entries = {
        keys.JOINT_POS: joint_pos, keys.JOINT_VEL: joint_vel, keys.TOOL_POS: tool_pos,
        keys.ROBOT_STATE: torch.cat([joint_pos, joint_vel, tool_pos], dim=-1),
        keys.TARGET_POS: history[:, -1], keys.TARGET_HISTORY: history, keys.GOAL: history[:, -1],
        keys.STEP_COUNT: torch.full((batch,), FIRST_PLAN),
    }  # fmt: skip
    return TensorDict(entries, batch_size=[batch])
