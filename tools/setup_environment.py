"""Makes `.venv`: the versions of `requirements.lock`, and this project in place. `make` runs it before everything else.

It needs Python's standard library alone and takes nothing on trust from earlier runs: `.venv` stays only if it was
finished for this Python, this folder and this lock. With the word `uv` it makes `.venv-uv`, for `make lock`.
"""

# ruff: noqa: T201
import sys

if sys.version_info < (3, 11):  # noqa: UP036
    sys.exit(
        "set-up: Python 3.11 or newer is needed, and %s is Python %d.%d. Name another: make PYTHON=python3.12"  # noqa: UP031
        % (sys.executable, sys.version_info[0], sys.version_info[1])
    )

import fcntl
import hashlib
import importlib.util
import os
import subprocess
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
VENV = PROJECT / ".venv"
STAMP = VENV / ".installed"
KIND = "import os, sysconfig; print(sysconfig.get_config_var('SOABI'), os.path.realpath(os.__file__))"


def main(words: list[str]) -> None:
    """Bring `.venv` up to date, or make `.venv-uv`."""
    os.chdir(PROJECT)
    if words == ["uv"]:
        make_environment(PROJECT / ".venv-uv")
        install(PROJECT / ".venv-uv", "uv>=0.8")
        return
    with Path("pyproject.toml").open("rb") as project:
        wait_for_others(project.fileno())
        kind = ask(sys.executable)
        packages = f"{VENV}\n{kind}\n{digest('requirements.lock')}\n"
        everything = packages + digest("pyproject.toml") + "\n"
        found = read_stamp() if ask(VENV / "bin" / "python") == kind else ""
        if found == everything:
            return
        if not found.startswith(packages):
            print("set-up: installs Python packages of 6 GB into .venv, which takes some minutes", flush=True)
            make_environment(VENV)
            install(VENV, "--require-hashes", "-r", "requirements.lock")
        STAMP.write_text(packages)
        print("set-up: installs this project into .venv", flush=True)
        install(VENV, "--no-deps", "--no-build-isolation", "-e", ".")
        STAMP.write_text(everything)


def wait_for_others(file: int) -> None:
    """Let a set-up that runs in another terminal end first."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print("set-up: waits for the one that runs already", flush=True)
        fcntl.flock(file, fcntl.LOCK_EX)
    except OSError:
        pass  # a file system without locks


def ask(python: str | Path) -> str:
    """Which Python this is, by its own word; nothing if it does not run."""
    try:
        return subprocess.run([python, "-I", "-c", KIND], capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def digest(name: str) -> str:
    """A file's content in one line."""
    return f"{name} {hashlib.sha256(Path(name).read_bytes()).hexdigest()}"


def read_stamp() -> str:
    """What `.venv` was finished for."""
    return STAMP.read_text() if STAMP.is_file() else ""


def make_environment(folder: Path) -> None:
    """An empty environment with pip, whatever was there before."""
    if not (importlib.util.find_spec("venv") and importlib.util.find_spec("ensurepip")):
        sys.exit(f"set-up: {sys.executable} cannot make environments. On Debian and Ubuntu: apt install python3-venv")
    import venv

    (folder / ".installed").unlink(missing_ok=True)
    if not folder.is_dir():
        folder.unlink(missing_ok=True)
    try:
        venv.create(folder, clear=True, symlinks=True, with_pip=True)
    except subprocess.CalledProcessError as error:
        sys.exit(f"{(error.output or b'').decode(errors='replace')}\nset-up: no pip in {folder}, for the reason above")


def install(folder: Path, *what: str) -> None:
    """Let the environment's own pip install something; its messages are the user's."""
    pip = [folder / "bin" / "python", "-m", "pip", "install", "--disable-pip-version-check", "--no-compile"]
    if subprocess.run([*pip, *what], check=False).returncode:
        sys.exit("set-up: pip failed, for the reason above. Run make again once it is gone; make clean starts over")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except OSError as error:
        sys.exit(f"set-up: {error}")
    except KeyboardInterrupt:
        sys.exit("set-up: stopped")
