"""What README shows first, works."""

import re
import subprocess
import sys
from pathlib import Path

README = Path(__file__).parent.parent / "README.md"


def test_the_first_code_traps_balls_and_says_how_many():
    code = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL).group(1)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300)
    assert run.returncode == 0, run.stderr
    share, balls = map(int, re.fullmatch(r"trapped (\d+)% of (\d+) balls\n", run.stdout).groups())
    assert balls > 200
    assert share > 55
