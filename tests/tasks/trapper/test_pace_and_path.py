"""The rival by pace and path in Trapper."""

from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.planners import PaceAndPath
from torchdyn_plan.tasks import load_task


def test_it_has_no_networks_and_runs_only_when_it_is_named():
    task = load_task("trapper")
    planner = task.planner("pace_and_path")
    assert isinstance(planner, PaceAndPath)
    assert not any(isinstance(module, Pretrained) for module in planner.modules())
    assert planner.scene == task.digest()
    assert "pace_and_path" not in task.default_planners


def test_it_traps_balls_that_pursuit_runs_after():
    how = {"velocity": 1.0, "episodes": 24, "num_envs": 24, "split": "dev", "num_threads": 1, "progress": False}
    found = evaluate("trapper", ["pace_and_path", "pursuit"], **how).outcomes
    again = evaluate("trapper", ["pace_and_path"], **how | {"num_envs": 7}).outcomes["pace_and_path"]
    ours = found["pace_and_path"]
    assert ours.success.sum() > found["pursuit"].success.sum()
    assert ours.steps.tolist() == again.steps.tolist()
