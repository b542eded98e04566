"""Whole planners in files: what ships, what a person saves, and what a damaged file is answered with."""

import dataclasses
import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.planners.first_plan import first_plan
from tests.planners.toy import (
    NO_MEMORY,
    Straight,
    StraightArrival,
    ToyEnv,
    assert_same,
    go_straight,
    make_planner,
)
from tests.tasks.trapper.crossing import MANEUVER, POCKETED
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.errors import InputError, OutputError, WeightsError
from torchdyn_plan.nets import (
    Actor,
    CaptureNetwork,
    ETANetwork,
    Forecaster,
    SpreadForecaster,
    SpreadNetwork,
    pretrained,
)
from torchdyn_plan.planners import (
    CornerSearch,
    Delayed,
    DynamicPlanner,
    EventSchedule,
    ExactSearch,
    IKPlanner,
    PolicyPlanner,
    ProportionalController,
    ReplanSchedule,
    SoftExactSearch,
)
from torchdyn_plan.planners import pretrained as planner_files
from torchdyn_plan.planners.pretrained import FILE, FORMAT
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.approach import BoxApproach
from torchdyn_plan.tasks.trapper.keep import GoToAndKeep
from torchdyn_plan.tasks.trapper.task import ik_planner
from torchdyn_plan.tasks.trapper.wait_and_drop import WaitAndDrop, waiting_search

pytestmark = pytest.mark.filterwarnings(NO_MEMORY)

ROOT = Path(__file__).parents[2]
WEIGHTS = pretrained.SHIPPED
SCENE = TrapperScene()


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """Untrained networks under the names that ship."""
    monkeypatch.setattr(pretrained, "SHIPPED", tmp_path)
    monkeypatch.setattr(planner_files, "SHIPPED", tmp_path)
    for file in WEIGHTS.glob("planner-*.json"):
        shutil.copy(file, tmp_path)
    torch.manual_seed(5)
    parts = Forecaster(hidden=8, channels=4), ETANetwork(hidden=8, never=False)
    parts[0].save_pretrained(tmp_path / "forecaster-trapper.safetensors")
    parts[1].save_pretrained(tmp_path / "eta-trapper-ik-nearest.safetensors")
    return tmp_path, parts


@pytest.fixture(scope="module")
def due():
    """An observation at which the paper's schedule plans."""
    return first_plan(3)


def test_a_planner_by_name_is_the_one_put_together_from_its_parts(shipped, due):
    forecaster, eta = shipped[1]
    planner = DynamicPlanner.from_pretrained("trapper-ik", static=ik_planner(chunk=4), chunk=4)
    parts = {"maneuver": GoToAndKeep.of(SCENE), "chunk": 4}
    by_hand = DynamicPlanner.paper(ik_planner(chunk=4), forecaster, eta, **parts).eval().requires_grad_(False)
    with torch.no_grad():
        one, other = planner(due.clone()), by_hand(due.clone())
    assert one["plan", "replanned"].all()
    assert_same(one, other)
    assert isinstance(DynamicPlanner.from_pretrained("trapper-ik").static, IKPlanner)
    assert (planner.chunk, planner.static.chunk) == (4, 4)


def test_a_learned_policy_comes_with_its_own_arrival_times(shipped, due):
    torch.manual_seed(6)
    actor, eta = Actor(hidden=8), ETANetwork(hidden=8, never=False)
    actor.save_pretrained(shipped[0] / "policy-trapper.safetensors")
    eta.save_pretrained(shipped[0] / "eta-trapper-rl-nearest.safetensors")
    planner = DynamicPlanner.from_pretrained("trapper-rl")
    policy = PolicyPlanner(actor.eval(), approach=BoxApproach.of(SCENE))
    by_hand = (
        DynamicPlanner.paper(policy, shipped[1][0], eta, maneuver=GoToAndKeep.of(SCENE)).eval().requires_grad_(False)
    )
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


def test_the_oracle_by_name_sees_the_truth_in_place_of_a_forecast(shipped, due, tmp_path):
    eta = shipped[1][1]
    eta.save_pretrained(tmp_path / "own" / "nearest_eta")
    oracle = load_task("trapper").planner("recorded_oracle", "ik", weights=tmp_path / "own", chunk=4, static_chunk=4)
    assert "target_future" in oracle.in_keys
    assert "target_history" not in oracle.in_keys
    assert (oracle.chunk, oracle.static.chunk) == (4, 4)
    assert all(torch.equal(a, b) for a, b in zip(oracle.eta.parameters(), eta.parameters(), strict=True))
    future = torch.full((3, 400, 3), 0.25)
    with torch.no_grad():
        planned = oracle(due.clone().set("target_future", future))
    still = planned["arrival_steps"] == 0
    assert torch.equal(planned["goal"][~still], future[:, 0][~still])
    assert torch.equal(planned["goal"][still], due["target_pos"][still])


def test_missing_weights_and_names_are_told(shipped):
    with pytest.raises(InputError, match=r"unknown planner 'trapper-kuka'.*trapper-ik"):
        DynamicPlanner.from_pretrained("trapper-kuka")
    file = shipped[0] / "eta-trapper-ik-nearest.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(WeightsError, match=r"eta of .*ik-nearest\.safetensors.*not a whole safetensors file"):
        DynamicPlanner.from_pretrained("trapper-ik")
    file.unlink()
    with pytest.raises(WeightsError, match=r"eta of .*no weights .*eta-trapper-ik.* for ETANetwork"):
        DynamicPlanner.from_pretrained("trapper-ik")


def test_one_that_waits_and_drops_comes_with_its_spread(shipped, due):
    ETANetwork(hidden=8).save_pretrained(shipped[0] / "eta-trapper-ik.safetensors")
    with pytest.raises(WeightsError, match=r"forecaster of .*no weights .*spread-trapper.* for SpreadNetwork"):
        DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop")
    SpreadNetwork(features=8).save_pretrained(shipped[0] / "spread-trapper.safetensors")
    with pytest.raises(WeightsError, match=r"forecaster of .*no weights .*forecaster-trapper-noisy"):
        DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop")
    noisy = Forecaster(hidden=8, channels=4, tracked=True), SpreadNetwork(features=8, tracked=True)
    for network in noisy:
        network.save_pretrained(shipped[0] / f"{network.kind}-trapper-noisy.safetensors")
    with pytest.raises(WeightsError, match=r"capture of .*no weights .*capture-trapper-ik.* for CaptureNetwork"):
        DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop")
    CaptureNetwork(hidden=8).save_pretrained(shipped[0] / "capture-trapper-ik.safetensors")
    planner = DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop", chunk=4)
    assert isinstance(planner.forecaster.exact, SpreadForecaster)
    assert isinstance(planner.forecaster.noisy, SpreadForecaster)
    assert (planner.search, planner.maneuver) == (waiting_search(SCENE, by_capture=True), WaitAndDrop.of(SCENE))
    assert (planner.schedule, planner.chunk) == (ReplanSchedule.every(5, first_step=3), 4)
    with torch.no_grad():
        td = planner(due.clone())
    assert bool(td["goal"].isfinite().all())
    assert td["plan", "replanned"].all()


def ship_planners():
    spec = importlib.util.spec_from_file_location("ship_planners", ROOT / "tools" / "ship_planners.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_ships_is_what_the_tasks_make():
    made = {name: json.loads(json.dumps(content)) for name, content in ship_planners().shipped_planners().items()}
    found = {
        file.stem.removeprefix("planner-"): json.loads(file.read_text()) for file in WEIGHTS.glob("planner-*.json")
    }
    assert made == found


@pytest.mark.parametrize("name", [file.stem.removeprefix("planner-") for file in WEIGHTS.glob("planner-*.json")])
def test_a_planner_that_ships_acts_as_its_tasks_own(name):
    task = next(task for task in shipping_tasks() if re.fullmatch(rf"{task.weights_name}-(\w+)(-\w+)?", name))
    static, *rest = name.removeprefix(f"{task.weights_name}-").split("-", 1)
    mine, own = DynamicPlanner.from_pretrained(name), task.planner(*(rest or ["corner"]), static)
    assert mine.scene == task.digest()
    assert played(mine, task) == played(own, task)


def shipping_tasks():
    """Tasks whose planners ship, in each of their scenes; those with the longest names of weights first."""
    tasks = [load_task("fetch_reach"), *(load_task("trapper", scene) for scene in load_task("trapper").scenes)]
    statics = [task for task in tasks if task.static_planners]
    return sorted(statics, key=lambda task: -len(task.weights_name))


def played(planner, task, steps=16):
    """Actions of the first steps of two episodes, every one of them."""
    env = task.make_env(task.default_settings(), num_envs=2, seed=0, split="dev", num_threads=1)
    return env.rollout(steps, planner, break_when_any_done=False)["action"].tolist()


@dataclasses.dataclass(frozen=True)
class Middle:
    """A person's own search: where the target is halfway along the forecast, or a ``share`` of it."""

    share: float = 0.5
    rest: ExactSearch = dataclasses.field(default_factory=ExactSearch)

    def __call__(self, forecast, target_pos, eta, context):
        cut = forecast._replace(path=forecast.path[..., : int(self.share * forecast.path.shape[-2]), :])
        return self.rest(cut, target_pos, eta, context)


def networks():
    torch.manual_seed(0)
    forecaster = Forecaster(square_symmetry=True, half_extent=0.75, hidden=16, channels=8).eval()
    spread = SpreadForecaster(forecaster, SpreadNetwork(features=16, hidden=8, rank=4).eval())
    return {"forecaster": forecaster, "spread": spread, "eta": ETANetwork(hidden=16).eval()}


def trapper_planner(**parts):
    found = networks()
    made = {"static": ik_planner(), "forecaster": found["forecaster"], "eta": found["eta"]}
    return DynamicPlanner.paper(**(made | parts)).eval().requires_grad_(False)


PLANNERS = {
    "ik": {},
    "policy": {"static": PolicyPlanner(Actor(hidden=8), period=3, approach=BoxApproach.of(SCENE))},
    "events": {"schedule": EventSchedule(maximum=40)},
    "late": {"delivery": Delayed(5)},
    "unaware": {"delivery": Delayed(3, compensate=False), "chunk": 4},
    "waiting": {
        "forecaster": networks()["spread"],
        "search": waiting_search(SCENE),
        "schedule": ReplanSchedule.every(5, first_step=13),
        "maneuver": WaitAndDrop.of(SCENE),
        "lost": POCKETED,
        "scene": SCENE.digest(),
    },
    "soft": {"search": SoftExactSearch(search=ExactSearch(stride=3), temperature=0.5)},
    "own": {"search": Middle(share=0.25)},
}


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_comes_back_from_its_folder_to_the_last_bit(name, tmp_path):
    planner = trapper_planner(**PLANNERS[name])
    file = planner.save_pretrained(tmp_path / "own")
    assert file == tmp_path / "own" / FILE
    loaded = DynamicPlanner.from_pretrained(tmp_path / "own")
    assert (loaded.in_keys, loaded.out_keys) == (planner.in_keys, planner.out_keys)
    for part in ("search", "schedule", "maneuver", "delivery", "lost", "chunk", "scene"):
        assert getattr(loaded, part) == getattr(planner, part), part
    one, other = (
        TrapperEnv(3, seed=0, num_threads=1, split="dev").rollout(30, each, break_when_any_done=False)
        for each in (planner, loaded)
    )
    for key in ("goal", "action", "arrival_steps", ("plan", "replanned"), ("plan", "status")):
        assert torch.equal(one[key], other[key]), key
    assert other["plan", "replanned"].any()
    # Written again, it is the same file.
    again = loaded.save_pretrained(tmp_path / "again")
    assert again.read_text() == file.read_text()


def test_a_folder_tells_what_is_in_it(tmp_path):
    trapper_planner(**PLANNERS["waiting"]).save_pretrained(tmp_path)
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {FILE, "planner.md", "forecaster.safetensors", "spread.safetensors", "eta.safetensors"}
    card = (tmp_path / "planner.md").read_text()
    assert "DynamicPlanner" in card
    assert "- search: torchdyn_plan.planners.search.exact:ExactSearch" in card
    assert "versions: " in card
    assert torch.__version__.partition("+")[0] in card
    content = json.loads((tmp_path / FILE).read_text())
    assert content["format"] == FORMAT
    assert content["parts"]["scene"] == SCENE.digest()


def test_parts_may_be_given_in_place_of_those_in_the_file(tmp_path):
    trapper_planner().save_pretrained(tmp_path)
    loaded = DynamicPlanner.from_pretrained(tmp_path, search=ExactSearch(), delivery=Delayed(2), chunk=8)
    assert (loaded.search, loaded.delivery, loaded.chunk) == (ExactSearch(), Delayed(2), 8)
    assert loaded.schedule == ReplanSchedule()
    with pytest.raises(InputError, match=r"unknown part 'serach'.*did you mean 'search'"):
        DynamicPlanner.from_pretrained(tmp_path, serach=ExactSearch())


def by_distance(forecast, target_pos, eta, context):
    return CornerSearch()(forecast, target_pos, eta, context)


OWN = [
    ("static", go_straight(), "CallablePlanner"),
    ("search", by_distance, "function"),
    ("eta", StraightArrival(), "StraightArrival"),
]


@pytest.mark.parametrize(("part", "value", "kind"), OWN)
def test_a_persons_own_function_must_be_given_again(part, value, kind, tmp_path):
    parts = {"static": ProportionalController(gain=1.0, action_size=3), part: value}
    planner = trapper_planner(**parts)
    planner.save_pretrained(tmp_path)
    assert f"- {part}: not saved" in (tmp_path / "planner.md").read_text()
    with pytest.raises(WeightsError, match=rf"{part} of .*it is a {kind}, which no file can hold: give it"):
        DynamicPlanner.from_pretrained(tmp_path)
    assert getattr(DynamicPlanner.from_pretrained(tmp_path, **{part: value}), part) is value


def test_a_toy_whose_parts_are_all_given_again_plays_alike(tmp_path):
    planner = make_planner()
    planner.save_pretrained(tmp_path)
    parts = {"static": go_straight(), "forecaster": Straight(), "eta": StraightArrival()}
    loaded = DynamicPlanner.from_pretrained(tmp_path, **parts)
    one, other = (ToyEnv(3).rollout(60, each, break_when_any_done=False) for each in (planner, loaded))
    assert_same(one, other)


@pytest.fixture
def saved(tmp_path):
    trapper_planner(search=ExactSearch()).save_pretrained(tmp_path)
    return tmp_path


def change(folder, edit):
    content = json.loads((folder / FILE).read_text())
    edit(content)
    (folder / FILE).write_text(json.dumps(content))


@pytest.mark.parametrize("kept", [0, 1, 40, 400, -2])
def test_a_truncated_file(saved, kept):
    text = (saved / FILE).read_text()
    (saved / FILE).write_text(text[:kept])
    with pytest.raises(WeightsError, match=rf"{FILE}' is no JSON file"):
        DynamicPlanner.from_pretrained(saved)


OTHER_FILES = [
    "[]",
    "3",
    "{}",
    '{"format": "another", "parts": {}}',
    '{"format": "torchdyn_plan.planner.1", "parts": 2}',
]


@pytest.mark.parametrize("content", OTHER_FILES)
def test_a_file_of_another_kind(saved, content):
    (saved / FILE).write_text(content)
    with pytest.raises(WeightsError, match=FILE):
        DynamicPlanner.from_pretrained(saved)


class Another(DynamicPlanner):
    """A class of planners of one's own."""


def test_a_planner_of_another_class(saved, tmp_path):
    with pytest.raises(WeightsError, match=r"holds torchdyn_plan.*:DynamicPlanner, expected .*:Another"):
        Another.from_pretrained(saved)
    own = Another(**trapper_planner().part_settings())
    own.save_pretrained(tmp_path / "own")
    assert isinstance(Another.from_pretrained(tmp_path / "own"), Another)
    with pytest.raises(WeightsError, match=r"Another, expected torchdyn_plan.*:DynamicPlanner"):
        DynamicPlanner.from_pretrained(tmp_path / "own")


def search_of(path, **settings):
    def edit(content):
        content["parts"]["search"] = {"part": path, "settings": settings}

    return edit


def put(part, value):
    def edit(content):
        content["parts"][part] = value

    return edit


def put_spread(value):
    def edit(content):
        content["parts"]["forecaster"]["settings"]["spread"] = value

    return edit


def network_of(path):
    return put("eta", {"network": path, "file": "eta.safetensors"})


DAMAGE = [
    (search_of("torchdyn_plan.planners.search.exact:ExactSearch", stride=0), "search of .*stride.*0"),
    (search_of("torchdyn_plan.planners.search.exact:ExactSearch", strid=2), "search of .*strid"),
    (search_of("torchdyn_plan.planners.search.exact:Exact"), "search of .*Exact"),
    (search_of("torchdyn_plan.planners.search.nowhere:ExactSearch"), "search of .*nowhere"),
    (search_of("torchdyn_plan.files:write_json"), "search of .*is not a part of a planner"),
    (search_of("torchdyn_plan.errors:InputError"), "search of .*is not a part of a planner"),
    (search_of(3), "search of "),
    (put("search", {"wrong": 1}), "search of .*cannot be made"),
    (network_of("torchdyn_plan.nets.forecaster:Forecaster"), "eta of .*ETANetwork"),
    (network_of("torchdyn_plan.planners.search.exact:ExactSearch"), "eta of .*not a part"),
    (put("chunk", {"dtype": "load"}), "chunk of .*torch.load is not a dtype"),
    (put("chunk", "many"), "chunk.*many"),
    (put("latency", 3), "latency"),
    (lambda content: content["parts"].pop("eta"), "eta"),
    (lambda content: content.pop("class"), "holds None, expected"),
]


@pytest.mark.parametrize(("edit", "message"), DAMAGE)
def test_a_damaged_part_is_told_by_name(saved, edit, message):
    change(saved, edit)
    with pytest.raises(WeightsError, match=message) as error:
        DynamicPlanner.from_pretrained(saved)
    assert str(saved / FILE) in str(error.value)


FOREIGN = ["antigravity:x", "smtpd:SMTPServer", "this:d", "tests.planners.nowhere:Part"]


@pytest.mark.parametrize("path", FOREIGN)
def test_foreign_code_is_not_imported(saved, path):
    module = path.partition(":")[0]
    assert module not in sys.modules
    change(saved, search_of(path))
    with pytest.raises(WeightsError, match=rf"search of .*it is a {path}, of a module that is not imported"):
        DynamicPlanner.from_pretrained(saved)
    assert module not in sys.modules


@pytest.mark.parametrize("path", ["os:system", "subprocess:Popen", "builtins:eval", "torch:load", "os:path"])
def test_what_is_imported_and_no_part_is_not_called(saved, path):
    change(saved, search_of(path, args="false"))
    with pytest.raises(WeightsError, match=rf"{path} is not a part of a planner"):
        DynamicPlanner.from_pretrained(saved)


def test_a_part_of_a_module_that_is_no_longer_imported(saved, tmp_path):
    trapper_planner(search=Middle()).save_pretrained(tmp_path / "own")
    text = (tmp_path / "own" / FILE).read_text()
    (tmp_path / "own" / FILE).write_text(text.replace(Middle.__module__, "my_searches"))
    with pytest.raises(WeightsError, match=r"my_searches:Middle, of a module that is not imported: import my_searches"):
        DynamicPlanner.from_pretrained(tmp_path / "own")
    given = DynamicPlanner.from_pretrained(tmp_path / "own", search=Middle())
    assert given.search == Middle()


def test_a_folder_without_a_planner_and_one_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=rf"holds no planner: it lacks {FILE}"):
        DynamicPlanner.from_pretrained(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        trapper_planner().save_pretrained(tmp_path / "file")


def test_parts_that_are_given_are_not_changed(tmp_path):
    trapper_planner().save_pretrained(tmp_path)
    own = ETANetwork(hidden=16)
    DynamicPlanner.from_pretrained(tmp_path, eta=own)
    assert own.training
    assert all(parameter.requires_grad for parameter in own.parameters())


def test_numbers_that_json_does_not_know_come_back(tmp_path):
    planner = trapper_planner(search=Middle(share=float("inf")))
    text = planner.save_pretrained(tmp_path).read_text()
    assert "Infinity" not in text
    assert DynamicPlanner.from_pretrained(tmp_path).search.share == float("inf")


LIGHT = """
import sys
import torch
from tensordict import TensorDict
from torchdyn_plan.planners import DynamicPlanner

for name in {names}:
    planner = DynamicPlanner.from_pretrained(name)
    still = torch.zeros(2, 3)
    size = 15 if "trapper" in name else 10
    seen = {{"tool_pos": still, "target_pos": still, "robot_state": torch.zeros(2, size)}}
    seen |= {{"target_history": torch.zeros(2, planner.forecaster.history, 3), "joint_pos": torch.zeros(2, 6)}}
    td = TensorDict({{**seen, "step_count": torch.zeros(2, dtype=torch.int64)}}, [2])
    for step in range(20):
        td["step_count"] = torch.full((2,), step)
        planner(td)
    assert (td["plan", "replans"] > 0).all(), name
    print(name, tuple(td["action"].shape))
heavy = {{"mujoco", "torchrl", "matplotlib", "tyro", "gymnasium", "numpy.f2py"}} & set(sys.modules)
assert not heavy, heavy
"""


def test_planners_load_and_plan_where_only_torch_is():
    names = [file.stem.removeprefix("planner-") for file in WEIGHTS.glob("planner-*.json")]
    done = subprocess.run(
        [sys.executable, "-c", LIGHT.format(names=names)], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(names) >= 6


def test_own_maneuvers_of_the_tests_are_saved_too(tmp_path):
    trapper_planner(maneuver=MANEUVER).save_pretrained(tmp_path)
    assert DynamicPlanner.from_pretrained(tmp_path).maneuver == MANEUVER
