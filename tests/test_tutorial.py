"""The tutorial's Python runs as it stands there, with its own assertions."""

import re
from pathlib import Path

TUTORIAL = Path(__file__).parents[1] / "docs" / "tutorial.md"


def test_every_block_of_the_tutorial():
    names: dict = {}
    text = TUTORIAL.read_text()
    blocks = list(re.finditer(r"```python\n(.*?)```", text, flags=re.DOTALL))
    assert len(blocks) > 5
    for block in blocks:
        above = text[: block.start(1)].count("\n")  # so that a failure names the line of the tutorial
        exec(compile("\n" * above + block[1], str(TUTORIAL), "exec"), names)
