"""The Python of the tutorial and of other pages runs as it stands there, with its own assertions."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.parametrize(
    ("page", "least"),
    [("tutorial", 6), ("forces", 1), ("starts", 1), ("index", 1), ("meshes", 4), ("settings", 2), ("runs", 1), ("ccd", 1)],
)
def test_every_block_of_a_page(page, least):
    names: dict = {}
    text = (DOCS / f"{page}.md").read_text()
    blocks = list(re.finditer(r"```python\n(.*?)```", text, flags=re.DOTALL))
    assert len(blocks) >= least
    for block in blocks:
        above = text[: block.start(1)].count("\n")  # so that a failure names the line of the page
        exec(compile("\n" * above + block[1], str(DOCS / f"{page}.md"), "exec"), names)
