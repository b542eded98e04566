import ast
import importlib
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import torchdyn_plan

ROOT = Path(torchdyn_plan.__file__).parent
WORDS = {"errors", "checks", "files", "keys", "lazy", "precision", "progress", "schemas", "stopping", "threads"}
"""What everything may use."""
MODELS = WORDS | {"versions", "kinematics", "nets", "planners"}
STUDIES = MODELS | {"envs", "tasks"}
"""What training, evaluation and benchmarks may use: of envs and tasks the general modules, see below."""
MAY_IMPORT = {
    **dict.fromkeys(sorted(WORDS), WORDS),
    "versions": set(),
    "kinematics": WORDS,
    "nets": WORDS | {"kinematics"},
    "planners": WORDS | {"kinematics", "nets", "versions"},
    "envs": WORDS | {"kinematics"},
    "tasks": STUDIES | {"training", "evaluation"},
    "training": STUDIES,
    "evaluation": STUDIES,
    "bench": STUDIES | {"evaluation"},
    "view": STUDIES | {"evaluation"},
    "cli": STUDIES | {"training", "evaluation", "bench", "view"},
    "gym": set(),
}
TASKS = sorted(folder.name for folder in (ROOT / "tasks").iterdir() if (folder / "task.py").is_file())
FACES = {ROOT / "envs" / "__init__.py", ROOT / "tasks" / "__init__.py", ROOT / "gym.py"}
"""Modules that say where the environments of tasks are, and which task commands take that name none."""
SIMULATION = {"torchrl", "mujoco", "matplotlib"}
HEAVY = SIMULATION | {"pytorch_kinematics", "torch", "tensordict", "numpy"}


def imports(tree: ast.AST, *, only_at_import: bool = False) -> Iterator[str]:
    """Dotted names of the modules that a file imports, anywhere or only when it is imported itself."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif not (only_at_import and is_skipped_at_import(node)):
            yield from imports(node, only_at_import=only_at_import)


def is_skipped_at_import(node: ast.AST) -> bool:
    if isinstance(node, ast.If):
        return isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)


def without_primer(tree: ast.Module) -> ast.Module:
    """``tree`` without `make_tensordict_primer`, which is for those who have TorchRL."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            node.body = [one for one in node.body if getattr(one, "name", "") != "make_tensordict_primer"] or [
                ast.Pass()
            ]
    return tree


def files_of(part: str) -> list[Path]:
    return sorted((ROOT / part).rglob("*.py")) if (ROOT / part).is_dir() else [ROOT / f"{part}.py"]


def own_part(name: str) -> str | None:
    top, _, rest = name.partition(".")
    return rest.split(".")[0] if top == "torchdyn_plan" and rest else None


@pytest.mark.parametrize("part", MAY_IMPORT)
def test_imports_run_downwards_only(part):
    for file in files_of(part):
        used = {own_part(name) for name in imports(ast.parse(file.read_text()))} - {None, part}
        assert used <= MAY_IMPORT[part], f"{file.relative_to(ROOT)} imports {used - MAY_IMPORT[part]}"


def general_files() -> list[Path]:
    """Modules that know no task."""
    own = [ROOT / room / task for room in ("envs", "tasks") for task in TASKS]
    files = [file for file in ROOT.rglob("*.py") if not any(folder in file.parents for folder in own)]
    return sorted(set(files) - FACES)


@cache
def names_of_tasks() -> set[str]:
    """Names of tasks, and of the classes and constants that their folders define."""
    found = set(TASKS)
    for room in ("envs", "tasks"):
        for task in TASKS:
            for file in (ROOT / room / task).rglob("*.py"):
                for node in ast.parse(file.read_text()).body:
                    if isinstance(node, ast.ClassDef):
                        found.add(node.name)
    return found


def test_there_are_tasks_and_names_to_look_for():
    assert TASKS == ["catch", "chase", "conveyor", "fetch_reach", "trapper"]
    assert names_of_tasks() > {"TrapperScene", "WaitAndDrop", "DynamicReachEnv", "BoxApproach", "trapper"}
    assert len(general_files()) > 60


@pytest.mark.parametrize("file", general_files(), ids=lambda file: str(file.relative_to(ROOT)))
def test_general_modules_know_no_task(file):
    tree, names = ast.parse(file.read_text()), names_of_tasks()
    for name in imports(tree):
        assert not any(f".{task}" in name for task in TASKS), f"imports {name}"
        assert own_part(name) != "cli" or ROOT / "cli" in file.parents or file == ROOT / "__main__.py", (
            f"imports {name}"
        )
    for node in ast.walk(tree):
        if isinstance(node, ast.Name | ast.Attribute):
            word = node.id if isinstance(node, ast.Name) else node.attr
            assert word not in names, f"line {node.lineno} names {word}"
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value.lower()
            said = [task for task in TASKS if task in text]
            assert not said, f"line {node.lineno} says {said[0]}"


@pytest.mark.parametrize("part", ["kinematics", "nets", "planners"])
def test_planners_and_below_know_no_simulation(part):
    for file in files_of(part):
        used = {name.split(".")[0] for name in imports(without_primer(ast.parse(file.read_text())))}
        # MuJoCo itself reads MJCF: for type checkers, and inside the function that asks for it.
        used -= {"mujoco"} if file == ROOT / "kinematics" / "mjcf.py" else set()
        assert not used & SIMULATION, f"{file.relative_to(ROOT)} imports {used & SIMULATION}"


def test_pytorch_kinematics_is_imported_inside_functions_only():
    for file in ROOT.rglob("*.py"):
        used = {name.split(".")[0] for name in imports(ast.parse(file.read_text()), only_at_import=True)}
        assert "pytorch_kinematics" not in used, f"{file.relative_to(ROOT)} imports it at its top"


def test_the_walk_sees_imports_at_both_levels():
    tree = ast.parse(
        "import a\nif x:\n    from b.c import d\ndef f():\n    import e.g\nclass K:\n    import h\n"
        "if TYPE_CHECKING:\n    import i"
    )
    assert set(imports(tree)) == {"a", "b.c.d", "e.g", "h", "i"}
    assert set(imports(tree, only_at_import=True)) == {"a", "b.c.d", "h"}


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import torchdyn_plan.cli", HEAVY | {"tyro"}),
        ("import torchdyn_plan.tasks; torchdyn_plan.tasks.load_task('trapper')", HEAVY),
        ("import torchdyn_plan; dir(torchdyn_plan); torchdyn_plan.load_task", HEAVY),
    ],
)
def test_importing_stays_light(statement, absent):
    code = f"import sys; {statement}; print(*({{name.split('.')[0] for name in sys.modules}} & {absent!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


LAZY = ["planners", "kinematics", "nets", "envs", "training", "view"]
"""Packages that import their public names on first use."""


def test_importing_a_package_loads_no_library():
    code = f"import sys, {', '.join(f'torchdyn_plan.{part}' for part in LAZY)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not {name.split(".")[0] for name in loaded} & HEAVY
    own = {"torchdyn_plan", "torchdyn_plan.lazy", "torchdyn_plan.errors", *(f"torchdyn_plan.{part}" for part in LAZY)}
    assert {name for name in loaded if name.startswith("torchdyn_plan")} == own


@pytest.mark.parametrize("part", ["", *LAZY])
def test_lazy_names_are_those_that_type_checkers_see(part):
    """The three lists of a package (homes, imports for type checkers, ``__all__``) agree, and each name is there."""
    package = importlib.import_module("torchdyn_plan" + (part and f".{part}"))
    tree = ast.parse(Path(package.__file__).read_text())
    skipped = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {name.rpartition(".")[2]: name.rpartition(".")[0] for node in skipped for name in imports(node)}
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)} | {"__version__"}
    assert set(package.__all__) - defined == set(seen)
    homes = ast.literal_eval(next(node.args[1] for node in ast.walk(tree) if isinstance(node, ast.Call)))
    listed = {name: f"{package.__name__}.{module}" for module, names in homes.items() for name in names}
    assert listed == seen
    assert set(package.__all__) <= set(dir(package))
    submodules = {one.name for one in pkgutil.iter_modules(package.__path__)}
    assert not set(seen) & submodules, "importing the submodule would hide the name"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        package.nonsense  # noqa: B018
    for name, module in seen.items():
        assert getattr(package, name) is getattr(importlib.import_module(module), name)


MAY_LOAD = {
    # tensordict itself takes seconds, as it imports torch._dynamo; what is above it is ours.
    "import torch, tensordict.nn": ("from torchdyn_plan.planners import DynamicPlanner", {"torchdyn_plan"}),
    "": (
        "import contextlib; from torchdyn_plan.cli import main\nwith contextlib.suppress(SystemExit): main(['--help'])",
        {"torchdyn_plan", "tyro", "docstring_parser", "typing_extensions", "typeguard"},
    ),
}
"""What is there already, what is run then, and the packages that it may load beside Python's own."""


@pytest.mark.parametrize("before", MAY_LOAD)
def test_planners_and_help_load_nothing_else(before):
    statement, allowed = MAY_LOAD[before]
    code = f"import sys\n{before}\nknown = {{*sys.modules}}\n{statement}\nprint('new:', *({{*sys.modules}} - known))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    new = {name.split(".")[0] for name in done.stdout.splitlines()[-1].removeprefix("new:").split()}
    assert "torchdyn_plan" in new
    others = {name for name in new - sys.stdlib_module_names if not name.startswith("_")}
    assert others <= allowed, sorted(others - allowed)
