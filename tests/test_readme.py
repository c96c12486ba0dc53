"""The README's Python runs as it stands there."""

import importlib.util
import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_python_of_the_readme(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [int(line[0]) for line in lines] == list(range(1, 51))
    heights = [float(line[3]) for line in lines]
    assert heights[-1] < heights[0] - 0.1  # the rim has sunk beside the ball
    assert max(int(line[2]) for line in lines) > 0  # barriers were at work


def test_links_of_the_packaged_readme():
    """Absolute where the address of the sources is known, text where it is not."""
    hatchling = pytest.importorskip("hatchling.metadata.plugin.interface", reason="needs hatchling, which builds the package")
    assert hatchling
    spec = importlib.util.spec_from_file_location("hatch_build", README.with_name("hatch_build.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = README.read_text()
    relative = [path for _, _, path in module.LINK.findall(text)]
    assert len(relative) > 15
    for path in relative:
        assert (README.parent / path.partition("#")[0]).exists(), path
    linked = module.readme(text, "https://example.org/pdipc/blob/v1/")
    assert not module.LINK.search(linked)
    assert "![A cloth" in linked and "(https://example.org/pdipc/blob/v1/docs/cloth_on_sphere.png?raw=true)" in linked
    alone = module.readme(text, None)
    assert "](docs/" not in alone and "![" not in alone and "Tutorial" in alone
