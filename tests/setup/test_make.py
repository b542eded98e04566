"""The real Makefile and the real pip, on a machine with a Python and little else; only the packages are stubs."""

import hashlib
import importlib.util
import shutil
import subprocess
import sys
import venv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.setup import backend

ROOT = Path(__file__).parents[2]
TOOLS = ("make", "sh", "rm", "env", "test", "touch", "mkdir", "dirname", "uname", "cat")
COMMANDS = ("pytest", "ruff", "basedpyright")
RUNS = (
    "import sys\ndef main():\n    print(sys.argv[0].split('/')[-1], 'ran in', sys.prefix, 'on', sys.version_info[:2])\n"
)
COMPILES = "import sys\ndef main():\n    open(sys.argv[sys.argv.index('-o') + 1], 'w').write(' '.join(sys.argv[1:]))\n"
NO_PIP = "sys.modules['ensurepip'] = None"

pytestmark = pytest.mark.skipif(
    not (shutil.which("make") and importlib.util.find_spec("ensurepip")), reason="needs make and ensurepip"
)


class Machine:
    """A bare machine: a project's folder, a PATH and an environment of its own."""

    def __init__(self, folder, project="project"):
        venv.create(folder / "system", symlinks=True)  # a Python with neither pip nor uv
        self.bin = folder / "system" / "bin"
        for tool in TOOLS:
            (self.bin / tool).symlink_to(shutil.which(tool))
        self.home = folder / "home"
        self.home.mkdir()
        wheels = folder / "wheels"
        wheels.mkdir()
        self.env = {"PATH": str(self.bin), "HOME": str(self.home), "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(wheels)}

        self.project = folder / project
        shutil.copytree(ROOT / "tools", self.project / "tools")
        for name in ("Makefile", "pyproject.toml"):
            shutil.copy(ROOT / name, self.project)
        (self.project / "torchdyn_plan").mkdir()
        (self.project / "torchdyn_plan" / "cli.py").write_text(RUNS)
        modules = {"hatchling/build.py": Path(backend.__file__).read_text(), "commands.py": RUNS}
        wheel = backend.write_wheel(wheels, "hatchling", "9.0", modules, dict.fromkeys(COMMANDS, "commands:main"))
        backend.write_wheel(wheels, "uv", "9.0", {"compiles.py": COMPILES}, {"uv": "compiles:main"})
        (self.project / "requirements.lock").write_text(
            f"absent==1.0 ; sys_platform == 'win32' \\\n    --hash=sha256:{'0' * 64}\n"
            f"hatchling==9.0 \\\n    --hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}\n"
        )

    def make(self, *words, **env):
        return subprocess.run(
            ["make", *words], cwd=self.project, env=self.env | env, capture_output=True, text=True, check=False
        )

    def python(self, name, code):
        """A Python that runs ``code`` before what it is told to run."""
        path = self.bin / name
        start = f"import runpy, sys; {code}; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
        path.write_text(f'#!/bin/sh\nexec {self.bin}/python3 -c "{start}" "$@"\n')
        path.chmod(0o755)
        return f"PYTHON={name}"

    def ran(self, command, done):
        """Whether ``command`` ran in the project's own environment."""
        assert done.returncode == 0, done.stdout + done.stderr
        return f"{command} ran in {self.project}/.venv on " in done.stdout


@pytest.fixture
def machine(tmp_path):
    return Machine(tmp_path)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A machine where ``make demo`` has run; the tests leave it so."""
    machine = Machine(tmp_path_factory.mktemp("finished"))
    machine.first = machine.make("demo")
    return machine


def test_demo_at_the_first_try_and_nothing_to_set_up_at_the_second(finished):
    assert finished.ran("torchdyn-plan", finished.first)
    assert "set-up: installs" in finished.first.stdout
    assert "which takes some minutes" in finished.first.stdout
    stamp = finished.project / ".venv" / ".installed"
    before = stamp.stat().st_mtime_ns
    done = finished.make("demo", "test", PIP_FIND_LINKS="/nowhere")
    assert finished.ran("torchdyn-plan", done)
    assert finished.ran("pytest", done)
    assert "set-up" not in done.stdout + done.stderr
    assert stamp.stat().st_mtime_ns == before
    assert not list(finished.home.iterdir()), "something was installed for the user"
    assert not list((finished.bin.parent / "lib").glob("python*/site-packages/*")), "something was installed for all"


def test_check_at_the_first_try_in_a_path_with_spaces_where_a_link_leads_nowhere(tmp_path):
    machine = Machine(tmp_path, "my project's folder")
    (machine.project / ".venv").symlink_to("/nowhere")
    done = machine.make("check")
    assert all(machine.ran(command, done) for command in COMMANDS)
    machine.make("clean")
    assert not list(machine.project.glob(".venv*"))


def test_test_at_the_first_try_in_a_shell_set_for_other_work_without_a_home(machine):
    old = machine.bin / "uv"
    old.write_text('#!/bin/sh\ntest "$1" = --version && echo uv 0.1.0\n')
    old.chmod(0o755)
    other = machine.project / "other" / "hatchling-9.0.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: hatchling\nVersion: 9.0\n")
    home = other / "METADATA" / "home"  # root may write anywhere, but not below a file
    assert machine.ran("pytest", machine.make("test", PYTHONPATH=str(other.parent), PIP_USER="1", HOME=str(home)))


def test_two_at_once_set_up_once(machine):
    with ThreadPoolExecutor() as both:
        done = list(both.map(machine.make, ("demo", "test")))
    assert machine.ran("torchdyn-plan", done[0])
    assert machine.ran("pytest", done[1])
    assert sum("set-up: installs Python" in each.stdout for each in done) == 1
    assert sum("set-up: waits" in each.stdout for each in done) == 1


def test_lock_at_the_first_try_whatever_the_lock_was(machine):
    lock = machine.project / "requirements.lock"
    lock.write_text("<<<<<<< ours")
    del machine.env["HOME"]
    done = machine.make("lock")
    assert done.returncode == 0, done.stdout + done.stderr
    assert lock.read_text().startswith("pip compile pyproject.toml ")


def test_a_lock_without_hashes_is_refused(machine):
    (machine.project / "requirements.lock").write_text("hatchling==9.0\n")
    done = machine.make("demo")
    assert done.returncode != 0
    assert "Hashes are required in --require-hashes mode" in done.stderr
    assert "ran in" not in done.stdout


def test_another_pyproject_installs_the_project_again(finished):
    finished.make("demo")
    mark = finished.project / ".venv" / "mark"
    mark.touch()
    pyproject = finished.project / "pyproject.toml"
    pyproject.write_text(
        pyproject.read_text().replace("[project.scripts]\n", "[project.scripts]\nnew = 'commands:main'\n")
    )
    assert finished.ran("torchdyn-plan", finished.make("demo"))
    assert (finished.project / ".venv" / "bin" / "new").exists()
    assert mark.exists()


def test_another_lock_offline_shows_the_cause_and_the_next_try_starts_over(finished):
    finished.make("demo")
    with (finished.project / "requirements.lock").open("a") as lock:
        lock.write("# one more line\n")
    offline = {"PIP_NO_INDEX": "0", "PIP_FIND_LINKS": "", "PIP_INDEX_URL": "http://127.0.0.1:9/", "PIP_RETRIES": "0"}
    done = finished.make("demo", **offline)
    assert done.returncode != 0
    assert "No matching distribution found for hatchling==9.0" in done.stderr
    assert "set-up: pip failed, for the reason above." in done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert "ran in" not in done.stdout
    half = finished.project / ".venv" / "half"
    half.touch()
    assert finished.ran("torchdyn-plan", finished.make("demo"))
    assert not half.exists()


def test_what_was_installed_in_another_folder_is_not_believed(finished):
    finished.make("demo")
    home, moved = finished.project, finished.project.with_name("moved")
    words = ["demo", finished.python("python3-minimal", NO_PIP)]
    assert finished.ran("torchdyn-plan", finished.make(*words)), "nothing had to be made"
    finished.project = home.rename(moved)
    done = finished.make(*words)
    finished.project = moved.rename(home)
    assert "cannot make environments" in done.stderr


def test_an_environment_whose_python_is_gone_is_made_anew(finished):
    finished.make("demo")
    python = finished.project / ".venv" / "bin" / "python"
    python.unlink()
    python.symlink_to("/nowhere/python")
    assert finished.ran("torchdyn-plan", finished.make("demo"))


def test_another_python_is_set_up_anew(finished):
    finished.make("demo")
    beside = Path(sys.base_prefix).parent.glob("*/bin/python3.1[1-9]")
    for python in filter(None, [*map(shutil.which, ("python3.11", "python3.12", "python3.13")), *beside]):
        ask = [python, "-c", "import ensurepip, sys; print(sys.version_info[:2])"]
        asked = subprocess.run(ask, capture_output=True, text=True, check=False)
        if asked.returncode == 0 and asked.stdout.strip() != str(sys.version_info[:2]):
            break
    else:
        pytest.skip("there is one Python alone")
    done = finished.make("demo", f"PYTHON={python}")
    assert finished.ran("torchdyn-plan", done)
    assert f" on {asked.stdout}" in done.stdout


def test_an_old_python_gets_one_sentence(machine):
    done = machine.make("demo", machine.python("python3.10", "sys.version_info = (3, 10, 13, 'final', 0)"))
    assert done.returncode != 0
    first, *rest = done.stderr.splitlines()
    assert first.startswith("set-up: Python 3.11 or newer is needed, and ")
    assert first.endswith(" is Python 3.10. Name another: make PYTHON=python3.12")
    assert [line for line in rest if not line.startswith("make: *** ")] == []
    assert done.stdout == ""


def test_a_python_that_cannot_make_environments_gets_one_sentence(machine):
    done = machine.make("demo", machine.python("python3-minimal", NO_PIP))
    assert done.returncode != 0
    assert "cannot make environments. On Debian and Ubuntu: apt install python3-venv\n" in done.stderr
    assert "Traceback" not in done.stderr


def test_nothing_is_forced_upon_the_system():
    for path in (ROOT / "Makefile", ROOT / ".ci" / "run", *(ROOT / "tools").glob("*.py")):
        assert "--break-system-packages" not in path.read_text()
