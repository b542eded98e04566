import pytest
import torch

from tests.planners.toy import assert_same
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.nets import Actor, ETANetwork, Forecaster, SpreadNetwork, pretrained
from torchdyn_plan.planners import (
    Adaptation,
    DynamicPlanner,
    IKPlanner,
    MeetingPlanner,
    OracleTrajectory,
    PolicyPlanner,
)
from torchdyn_plan.planners.approach import Approach
from torchdyn_plan.planners.meeting import CAUTIOUS, WAITING


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """Untrained networks under the names that ship."""
    monkeypatch.setattr(pretrained, "SHIPPED", tmp_path)
    torch.manual_seed(5)
    parts = Forecaster(hidden=8, channels=4), ETANetwork(hidden=8)
    parts[0].save_pretrained(tmp_path / "forecaster-trapper.safetensors")
    parts[1].save_pretrained(tmp_path / "eta-trapper-ik.safetensors")
    return tmp_path, parts


@pytest.fixture(scope="module")
def due():
    """An observation at which the paper's schedule plans."""
    env = TrapperEnv(3, num_threads=1)
    td = env.reset()
    for _ in range(13):
        td = env.step_mdp(env.step(td.set("action", torch.zeros(3, 6))))
    return td.exclude("action")


def test_a_planner_by_name_is_the_one_put_together_from_its_parts(shipped, due):
    forecaster, eta = shipped[1]
    planner = DynamicPlanner.from_pretrained("trapper-ik", chunk=4)
    by_hand = DynamicPlanner(IKPlanner(chunk=4), forecaster.eval(), eta.eval(), chunk=4)
    with torch.no_grad():
        one, other = planner(due.clone()), by_hand(due.clone())
    assert one["plan", "replanned"].all()
    assert_same(one, other)
    assert isinstance(planner.static, IKPlanner)
    assert (planner.chunk, planner.static.chunk) == (4, 4)


def test_a_learned_policy_comes_with_its_own_arrival_times(shipped, due):
    torch.manual_seed(6)
    actor, eta = Actor(hidden=8), ETANetwork(hidden=8)
    actor.save_pretrained(shipped[0] / "policy-trapper.safetensors")
    eta.save_pretrained(shipped[0] / "eta-trapper-rl.safetensors")
    planner = DynamicPlanner.from_pretrained("trapper-rl")
    by_hand = DynamicPlanner(PolicyPlanner(actor.eval(), approach=Approach()), shipped[1][0].eval(), eta.eval())
    with torch.no_grad():
        one, other = planner(due.clone()), by_hand(due.clone())
    assert_same(one, other)
    assert isinstance(planner.static, PolicyPlanner)


def test_it_is_ready_to_run_and_not_to_train(shipped):
    planner = DynamicPlanner.from_pretrained("trapper-ik")
    assert not any(module.training for module in planner.modules())
    assert not any(parameter.requires_grad for parameter in planner.parameters())
    assert sum(1 for _ in planner.parameters()) > 10
    assert planner.chunk is None


def test_the_oracle_by_name_sees_the_truth_in_place_of_a_forecast(shipped, due):
    oracle = OracleTrajectory.from_pretrained("trapper-ik", chunk=4)
    assert "target_future" in oracle.in_keys
    assert "target_history" not in oracle.in_keys
    assert (oracle.chunk, oracle.static.chunk) == (4, 4)
    eta = shipped[1][1]
    assert all(torch.equal(a, b) for a, b in zip(oracle.eta.parameters(), eta.parameters(), strict=True))
    future = torch.full((3, 400, 3), 0.25)
    with torch.no_grad():
        planned = oracle(due.clone().set("target_future", future))
    still = planned["arrival_steps"] == 0
    assert torch.equal(planned["goal"][~still], future[:, 0][~still])
    assert torch.equal(planned["goal"][still], due["target_pos"][still])


@pytest.mark.parametrize("kind", [DynamicPlanner, OracleTrajectory])
def test_missing_weights_and_names_are_told(shipped, kind):
    with pytest.raises(InputError, match=r"unknown planner 'trapper-kuka'.*trapper-ik"):
        kind.from_pretrained("trapper-kuka")
    file = shipped[0] / "eta-trapper-ik.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(WeightsError, match=r"eta-trapper-ik\.safetensors.*not a whole safetensors file"):
        kind.from_pretrained("trapper-ik")
    file.unlink()
    with pytest.raises(WeightsError, match=r"no weights 'trapper-ik' for ETANetwork.*names that ship \(none\)"):
        kind.from_pretrained("trapper-ik")


def test_a_cautious_planner_by_name_gets_the_spread_and_another_needs_none(shipped, due):
    planner = MeetingPlanner.from_pretrained("trapper-ik", search=WAITING, chunk=4)
    assert (planner.search, planner.spread, planner.adaptation) == (WAITING, None, None)
    with pytest.raises(WeightsError, match="no weights 'trapper' for SpreadNetwork"):
        MeetingPlanner.from_pretrained("trapper-ik", search=CAUTIOUS)
    SpreadNetwork(features=8).save_pretrained(shipped[0] / "spread-trapper.safetensors")
    planner = MeetingPlanner.from_pretrained("trapper-ik", search=CAUTIOUS, adaptation=Adaptation(), chunk=4)
    assert isinstance(planner.spread, SpreadNetwork)
    assert (planner.search, planner.chunk, planner.static.chunk) == (CAUTIOUS, 4, 4)
    with torch.no_grad():
        td = planner(due.clone())
    assert bool(td["goal"].isfinite().all())
    assert set(planner.out_keys) >= {("plan", "drags"), "goal", "action"}
