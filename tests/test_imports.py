import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchdyn_plan

ROOT = Path(torchdyn_plan.__file__).parent
WORDS = {"errors", "checks", "files", "keys"}
MAY_IMPORT = {
    **dict.fromkeys(sorted(WORDS), WORDS),
    "versions": set(),
    "kinematics": WORDS,
    "nets": WORDS | {"kinematics"},
    "planners": WORDS | {"kinematics", "nets"},
    "envs": WORDS | {"kinematics"},
}
SIMULATION = {"torchrl", "mujoco", "matplotlib"}


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


@pytest.mark.parametrize("part", ["kinematics", "nets", "planners"])
def test_planners_and_below_know_no_simulation(part):
    for file in files_of(part):
        used = {name.split(".")[0] for name in imports(ast.parse(file.read_text()))}
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
        ("import torchdyn_plan.planners", SIMULATION | {"pytorch_kinematics"}),
        ("import torchdyn_plan.cli", SIMULATION | {"pytorch_kinematics", "torch", "tensordict", "tyro", "numpy"}),
    ],
)
def test_importing_stays_light(statement, absent):
    code = f"import sys; {statement}; print(*({{name.split('.')[0] for name in sys.modules}} & {absent!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
