"""The README's Python runs as it stands there."""

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_python_of_the_readme(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [int(line[0]) for line in lines] == list(range(1, 51))
    heights = [float(line[3]) for line in lines]
    assert heights[-1] < heights[0] - 0.1  # the rim has sunk beside the ball
    assert max(int(line[2]) for line in lines) > 0  # barriers were at work
