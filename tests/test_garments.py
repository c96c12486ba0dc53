"""The Python of docs/garments.md runs as it stands there, with its own assertions."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "garments.md"


def test_every_block_of_the_page():
    names: dict = {}
    text = PAGE.read_text()
    blocks = list(re.finditer(r"```python\n(.*?)```", text, flags=re.DOTALL))
    assert len(blocks) >= 2
    for block in blocks:
        above = text[: block.start(1)].count("\n")  # so that a failure names the line of the page
        exec(compile("\n" * above + block[1], str(PAGE), "exec"), names)
