"""Runs scripts as a person does, each in a process of its own, but without importing the libraries for each anew.

Processes are forked from one that has imported them and done nothing else.
"""

import multiprocessing
import os
import runpy
import sys
import tempfile
import types
from pathlib import Path
from typing import NamedTuple

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    ["torch", "torch._dynamo", "tensordict.nn", "torchrl.envs", "torchrl.collectors", "torchrl.data", "mujoco", "tyro"]
)


class Run(NamedTuple):
    """What came of a script."""

    returncode: int
    stdout: str
    stderr: str


def run(script, *words, cwd, timeout=300, **environment):
    """Run a file, or a text as of ``python -c``, with ``words`` behind it and more in its ``environment``."""
    with tempfile.TemporaryDirectory() as folder:
        said = [Path(folder) / name for name in ("stdout", "stderr")]
        process = CONTEXT.Process(target=_run, args=(script, list(map(str, words)), str(cwd), environment, said))
        process.start()
        process.join(timeout)
        if process.is_alive():
            process.kill()
            process.join()
            raise TimeoutError(f"{script} {words} ran for more than {timeout} s")
        return Run(process.exitcode, *(file.read_text() for file in said))


def _run(script, words, cwd, environment, said):
    for descriptor, file in zip((1, 2), said, strict=True):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), descriptor)
    os.chdir(cwd)
    os.environ.update(environment)
    sys.argv = [str(script), *words]
    if isinstance(script, Path):
        sys.path.insert(0, str(script.parent))
        runpy.run_path(str(script), run_name="__main__")
        return
    sys.argv[0] = "-c"
    main = sys.modules["__main__"] = types.ModuleType("__main__")
    exec(compile(script, "<string>", "exec"), main.__dict__)
