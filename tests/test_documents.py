"""Python in documents runs as it stands there."""

import re
import runpy
from pathlib import Path

import pytest

import pdipc

DOCS = Path(__file__).parents[1] / "docs"
NEEDS = {"pictures": "pyvista", "rods": "pdipc", "rigid": "pdipc", "materials": "pdipc", "loads": "pdipc"}


@pytest.mark.parametrize("page", NEEDS)
def test_python_of_the_page(page):
    pytest.importorskip(NEEDS[page], reason=f"needs {NEEDS[page]} (extra: {page})")
    names: dict = {}
    text = (DOCS / f"{page}.md").read_text()
    blocks = list(re.finditer(r"```python\n(.*?)```", text, flags=re.DOTALL))
    assert blocks
    for block in blocks:
        above = text[: block.start(1)].count("\n")  # so that a failure names the line of the page
        exec(compile("\n" * above + block[1], page, "exec"), names)


def test_scenes_of_the_pictures_start_as_they_are():
    for name, (made, frames, _) in runpy.run_path(str(DOCS / "draw_bodies.py"))["PICTURES"].items():
        scene = made()
        assert pdipc.check_scene(scene) == [], name
        assert max(frames) <= scene.simulation.steps
