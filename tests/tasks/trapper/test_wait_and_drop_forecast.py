import dataclasses

import torch

from tests.planners.toy import HISTORY, assert_same
from tests.tasks.trapper.crossing import SEARCH, make_planner, world
from torchdyn_plan.nets import Forecaster, SpreadForecaster, SpreadNetwork


def networks():
    torch.manual_seed(0)
    forecaster = Forecaster(history=HISTORY, horizon=150, hidden=16, channels=8)
    return forecaster.eval(), SpreadNetwork(features=16, horizon=150, hidden=8, rank=4).eval()


def test_a_spread_is_read_by_a_search_that_weighs_probability_only():
    forecaster, spread = networks()
    found = {}
    with torch.no_grad():
        spread.head.weight.normal_()
        judged = SpreadForecaster(forecaster, spread)
        for model, weight in ((forecaster, 0.0), (judged, 0.0), (judged, 40.0)):
            search = dataclasses.replace(SEARCH, probability_weight=weight)
            planner = make_planner(search=search).with_parts(forecaster=model)
            found[model is judged, weight] = world(16).run(planner, 14)[-1]
    assert_same(found[False, 0.0], found[True, 0.0])
    assert not torch.equal(found[True, 40.0]["goal"], found[True, 0.0]["goal"])
