import itertools

import pytest
import torch

from torchdyn_plan.evaluation.failures import CAUSES, SUCCESS, failure_cause, failure_shares


def by_hand(trapped, solvable, touched, pocketed):
    if trapped:
        return None
    if not solvable:
        return "out_of_reach"
    if touched:
        return "too_early"
    return "pocketed" if pocketed else "too_late"


def test_all_sixteen_cases():
    cases = list(itertools.product([False, True], repeat=4))
    causes = failure_cause(*torch.tensor(cases).unbind(-1))
    found = [None if code == SUCCESS else CAUSES[code] for code in causes.tolist()]
    assert found == [by_hand(*case) for case in cases]


def test_any_batch_shape():
    flags = torch.rand(4, 3, 5, generator=torch.Generator().manual_seed(0)) > 0.5
    together = failure_cause(*flags)
    assert together.shape == (3, 5)
    assert together.flatten().tolist() == failure_cause(*flags.flatten(1)).tolist()
    assert failure_cause(*flags[:, 0, 0]).shape == ()


def test_shares_are_of_all_episodes():
    codes = torch.tensor([SUCCESS, SUCCESS, 0, 1, 1, 3, SUCCESS, 3])
    assert failure_shares(codes) == {"out_of_reach": 1 / 8, "too_early": 2 / 8, "pocketed": 0.0, "too_late": 2 / 8}


def test_shares_and_success_add_up():
    codes = torch.randint(SUCCESS, len(CAUSES), (1000,), generator=torch.Generator().manual_seed(0))
    assert sum(failure_shares(codes).values()) + (codes == SUCCESS).double().mean().item() == pytest.approx(1.0)
