import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ETAConfig, ETANetwork
from torchdyn_plan.nets.distributions import decode_expectation, decode_mode
from torchdyn_plan.nets.eta import arrival_classes


@pytest.fixture
def network():
    torch.manual_seed(0)
    return ETANetwork(hidden=16).double().eval()


def samples(*batch):
    draw = torch.Generator().manual_seed(0)
    rand = lambda size: torch.rand(*batch, size, generator=draw, dtype=torch.float64)  # noqa: E731
    return rand(15), rand(3)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_batch_is_free_and_equals_a_loop(network, batch):
    state, goal = samples(*batch)
    logits = network(state, goal)
    assert logits.shape == (*batch, 101)
    rows = [network(s, g) for s, g in zip(state.reshape(-1, 15), goal.reshape(-1, 3), strict=True)]
    torch.testing.assert_close(logits.reshape(-1, 101), torch.stack(rows))


def test_one_state_serves_many_goals(network):
    state, _ = samples(2)
    goal = torch.rand(2, 4, 3, dtype=torch.float64)
    logits = network(state.unsqueeze(1), goal)
    assert logits.shape == (2, 4, 101)
    torch.testing.assert_close(logits, network(state.unsqueeze(1).expand(-1, 4, -1), goal))


def test_gradient_is_right_and_finite_at_the_tool(network):
    state, goal = samples(2)
    assert torch.autograd.gradcheck(lambda s, g: network(s, g)[:, ::9], (state.requires_grad_(), goal.requires_grad_()))
    at_tool = state[:, 12:].detach().requires_grad_()
    network(state, at_tool).sum().backward()
    assert bool(at_tool.grad.isfinite().all())


def test_statistics_standardise_the_inputs(network):
    state, goal = samples(500)
    state = state * 7 + 3
    network.set_input_statistics(state, goal)
    seen = network.state_shift + state * network.state_scale
    torch.testing.assert_close(seen.mean(0), torch.zeros(15, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(seen.std(0), torch.ones(15, dtype=torch.float64))


def test_mode_is_the_middle_of_the_likeliest_bin():
    logits = torch.full((101, 101), -9.0).fill_diagonal_(9.0)
    steps, never = decode_mode(logits)[:2]
    assert steps[:100].tolist() == [5 * k + 2 for k in range(100)]
    assert never.tolist() == [False] * 100 + [True]


def test_expectation_lies_between_bins_and_never_is_a_majority():
    shares = torch.zeros(3, 101)
    shares[0, [4, 5]] = torch.tensor([0.25, 0.75])
    shares[1, [4, 100]] = torch.tensor([0.45, 0.55])
    shares[2, [4, 9, 100]] = torch.tensor([0.3, 0.3, 0.4])
    steps, never = decode_expectation(shares.log())[:2]
    assert steps.tolist() == pytest.approx([22 + 0.75 * 5, 22, (22 + 47) / 2])
    assert never.tolist() == [False, True, False]


def test_targets_are_unbiased_and_hold_their_bin():
    arrival = torch.arange(500)
    classes, holding = arrival_classes(arrival)
    assert classes.shape == (500, 101)
    torch.testing.assert_close(classes.sum(-1), torch.ones(500))
    assert bool(((classes > 0).sum(-1) <= 2).all())
    assert torch.equal(classes.argmax(-1), holding)
    assert torch.equal(holding, arrival // 5)
    steps, never = decode_expectation(classes.log())[:2]
    # The outer halves of the first and the last bin have no neighbour to lean on.
    torch.testing.assert_close(steps, arrival.clamp(2, 497).float(), atol=1e-3, rtol=0)
    assert not never.any()


def test_targets_of_never():
    classes, holding = arrival_classes(torch.tensor([-1, 500, 12, 1200]))
    assert holding.tolist() == [100, 100, 2, 100]
    assert classes[:, 100].tolist() == [1.0, 1.0, 0.0, 1.0]
    assert classes.sum().item() == 4.0


def test_targets_with_bins_of_one_step():
    classes, holding = arrival_classes(torch.arange(-1, 7), bins=6, bin_width=1)
    assert holding.tolist() == [6, 0, 1, 2, 3, 4, 5, 6]
    assert torch.equal(classes, torch.eye(7)[holding])


@pytest.mark.parametrize("estimator", ["mode", "expectation"])
def test_arrival_reads_the_logits(network, estimator):
    state, goal = samples(8)
    arrival = network.arrival(state, goal, estimator=estimator)
    expected = {"mode": decode_mode, "expectation": decode_expectation}[estimator](network(state, goal))
    assert torch.equal(arrival.steps, expected.steps)
    assert torch.equal(arrival.never, expected.never)
    assert arrival.bins is None


def test_a_distribution_is_the_expectation_and_the_shares_of_the_bins(network):
    state, goal = samples(8)
    arrival, shares = network.arrival(state, goal, estimator="distribution"), network(state, goal).softmax(-1)
    expected = network.arrival(state, goal, estimator="expectation")
    assert torch.equal(arrival.steps, expected.steps)
    assert torch.equal(arrival.never, expected.never)
    assert torch.equal(arrival.bins, shares[:, :100])
    assert arrival.bin_width == 5
    soft = network.arrival(state, goal, estimator="soft")
    torch.testing.assert_close(soft.never, 1 - arrival.bins.sum(-1))


def test_wrong_inputs_are_named(network):
    state, goal = samples(2)
    with pytest.raises(InputError, match=r"robot_state.*15.*\(2, 14\)"):
        network(state[:, :14], goal)
    with pytest.raises(InputError, match=r"goal.*\(2, 2\)"):
        network(state, goal[:, :2])
    with pytest.raises(InputError, match="goal must be finite"):
        network(state, goal * float("nan"))
    with pytest.raises(InputError, match="expectation"):
        network.arrival(state, goal, estimator="expectaton")
    with pytest.raises(InputError, match=r"tool_slice.*\(13, 16\)"):
        ETAConfig(tool_slice=(13, 16))


def test_a_network_without_never_gives_it_no_chance_in_any_form(tmp_path):
    torch.manual_seed(0)
    network = ETANetwork(hidden=16, never=False).double().eval()
    state, goal = samples(50)
    logits = network(state, goal)
    assert network.head.out_features == 100
    assert logits.shape == (50, 101)
    assert bool((logits[:, -1] == -torch.inf).all())
    torch.testing.assert_close(network.for_inference()(state, goal), logits)
    for estimator in ("mode", "expectation", "distribution", "soft"):
        arrival = network.arrival(state, goal, estimator=estimator)
        assert bool(arrival.steps.isfinite().all())
        assert not arrival.never.any()
    goal.requires_grad_()
    network.arrival(state, goal, estimator="soft").steps.sum().backward()
    assert bool(goal.grad.isfinite().all())
    restored = ETANetwork.from_pretrained(network.save_pretrained(tmp_path))
    assert restored.config.never is False
    torch.testing.assert_close(restored(state.float(), goal.detach().float()), logits.float(), atol=1e-5, rtol=0)


def test_of_a_pose_it_reads_the_orientation(tmp_path):
    torch.manual_seed(0)
    network = ETANetwork(hidden=16, turned=True).double().eval()
    state, place = samples(5)
    turn = torch.nn.functional.normalize(torch.randn(5, 4, dtype=torch.float64), dim=-1)
    turn[0] = 0.0
    pose = torch.cat([place, turn], dim=-1)
    network.set_input_statistics(state, pose)
    logits = network(state, pose)
    torch.testing.assert_close(network(state, pose * pose.new_tensor([1.0] * 3 + [-1.0] * 4)), logits)
    turned_otherwise = torch.cat([place, turn.roll(1, dims=-1)], dim=-1)
    changed = (network(state, turned_otherwise) - logits).abs().amax(-1)
    assert changed[0] == 0.0
    assert changed[1:].min() > 1e-3
    torch.testing.assert_close(network.for_inference()(state, pose), logits)
    several = pose.unsqueeze(0).expand(5, 5, 7)
    read = network.for_inference().from_state(state)(several, estimator="expectation")
    torch.testing.assert_close(read.steps, network.arrival(state.unsqueeze(1), several, estimator="expectation").steps)
    restored = ETANetwork.from_pretrained(network.save_pretrained(tmp_path))
    torch.testing.assert_close(restored(state.float(), pose.float()), logits.float(), atol=1e-5, rtol=0)
    with pytest.raises(InputError, match=r"goal.*7.*\(5, 3\)"):
        network(state, place)
    with pytest.raises(InputError, match="turned goals need"):
        ETAConfig(robot_state_size=4, tool_slice=(0, 2), turned=True)


def test_whether_there_is_never_is_a_yes_or_a_no():
    with pytest.raises(InputError, match="never must be True or False, got 1"):
        ETAConfig(never=1)
