import pytest
import torch

from torchdyn_plan.evaluation import bench_env, bench_replan
from torchdyn_plan.evaluation.play import play
from torchdyn_plan.evaluation.replan_parts import in_blocks, steps
from torchdyn_plan.evaluation.run import EpisodeLog
from torchdyn_plan.evaluation.timing import figures, sample
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import DynamicPlanner, IKPlanner, TargetPursuit

COLUMNS = {
    "what", "implementation", "batch", "threads", "compiled", "device", "median_us", "p95_us", "p99_us", "per_item_us",
    "max_error",
}  # fmt: skip


@pytest.fixture(scope="module")
def planner():
    torch.manual_seed(0)
    parts = IKPlanner(), Forecaster(square_symmetry=True, half_extent=0.75), ETANetwork()
    return DynamicPlanner(*parts).eval().requires_grad_(False)


def test_figures_are_in_microseconds_and_for_one_item():
    row = figures([1e-6, 2e-6, 3e-6, 10e-6], batch=2)
    assert row["median_us"] == pytest.approx(2.5)
    assert row["p95_us"] == pytest.approx(8.95)
    assert row["per_item_us"] == pytest.approx(2.0)


def test_a_sample_has_its_least_number_of_calls_and_one_more_is_not_counted():
    calls = []
    assert len(sample(lambda: calls.append(0), seconds=0.0, least=5)) == 5
    assert len(calls) == 6


def test_mujoco_alone_repeats_the_loop_bit_for_bit_through_resets():
    rows = bench_env.bench({"pursuit": lambda: TargetPursuit(IKPlanner(chunk=16))}, sizes=(3,), steps=500, threads=1)
    assert [(row["what"], row["implementation"]) for row in rows] == [
        ("random", "mujoco.batch"), ("random", "TrapperEnv"),
        ("pursuit", "mujoco.batch"), ("pursuit", "evaluation loop"),
    ]  # fmt: skip
    for row in rows:
        assert row.keys() >= COLUMNS | {"share_of_raw", "env_steps_per_second"}
        assert row["max_error"] == 0.0
        assert (row["batch"], row["threads"]) == (3, 1)
    assert rows[0]["share_of_raw"] == rows[2]["share_of_raw"] == 1.0


def test_a_tape_holds_every_reset():
    env, taped = bench_env._taped_env(6, 1)
    log = EpisodeLog.empty(60)
    loop = play(TargetPursuit(IKPlanner(chunk=16)), env, log)
    for _ in range(330):
        next(loop)
    assert log.done.any()
    assert len(taped.tape) == 330
    resets = [reset for entry in taped.tape for reset in entry.resets] + taped.pending
    assert sum(len(reset.rows) for reset in resets) == 6 + int(log.done.sum())


def test_a_tape_that_lacks_a_reset_shows_as_an_error(monkeypatch):
    monkeypatch.setattr(bench_env.TapedSimulation, "reset", bench_env.TrapperSimulation.reset)
    rows = bench_env.bench({"pursuit": lambda: TargetPursuit(IKPlanner(chunk=16))}, sizes=(2,), steps=5, threads=1)
    assert all(row["max_error"] > 0.0 for row in rows)


def test_a_replan_is_measured_in_its_parts_and_a_batch_equals_its_rows(planner):
    rows = bench_replan.bench(planner, batches=(1, 5), seconds=0.0, compiled=False)
    names = [(row["what"], row["implementation"]) for row in rows if row["batch"] == 5 and row["device"] == "cpu"]
    both = ["forecast", "ETA, 1 goal", "ETA, 4 goals", "ETA, 60 goals"]
    both += ["re-plan, corner", "re-plan, exact", "re-plan, exact, coarse to fine", "re-plan, meet"]
    alone = ["search alone, corner", "search alone, exact", "search alone, exact, coarse to fine"]
    alone += ["IK path of 5 steps", "planner step that plans", "planner step between plans"]
    assert names == [(name, "torchdyn_plan") for name in both + alone] + [(n, "torchdyn_plan, folded") for n in both]
    for row in rows:
        assert row.keys() >= COLUMNS | {"per_second"}
        assert not row["compiled"]
        assert row["max_error"] < 1e-3, row
        assert row["median_us"] > 0.0


def test_rows_that_depend_on_their_batch_show_as_an_error():
    seen = bench_replan.observations(4)
    once, twice = lambda td: (td["goal"] - td["goal"].mean(dim=0),), lambda td: (td["goal"] * 2.0,)
    assert bench_replan._error(once, once, seen) > 1e-3
    assert bench_replan._error(twice, once, seen) > 1e-3
    assert bench_replan._error(twice, twice, seen) == 0.0


def test_more_rows_than_a_block_are_worked_on_block_by_block():
    sizes = []
    part = lambda one, other: (sizes.append(len(one)), (one + other, other))[1]  # noqa: E731
    found = in_blocks(part, 4, torch.arange(10), torch.ones(10))
    assert sizes == [4, 4, 2]
    assert torch.equal(found[0], torch.arange(1, 11))
    in_blocks(part, 10, torch.arange(10), torch.ones(10))
    assert sizes[3:] == [10]


def test_the_planner_step_that_plans_plans_and_the_other_does_not(planner, monkeypatch):
    calls = []
    plan = DynamicPlanner.plan_ahead
    monkeypatch.setattr(DynamicPlanner, "plan_ahead", lambda self, *seen: (calls.append(0), plan(self, *seen))[1])
    seen = bench_replan.observations(3)
    seen.set("plan", planner(seen.copy())["plan"])
    parts = steps(planner)
    for what, planned in (("planner step between plans", 0), ("planner step that plans", 1)):
        calls.clear()
        part, inputs = parts[what]
        part(*inputs(seen))
        assert len(calls) == planned
