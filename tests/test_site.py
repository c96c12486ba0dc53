"""The documents as a whole: every link leads somewhere, every page is in the navigation, every public name in the reference, and the site builds."""

import importlib.util
import itertools
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pdipc

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
LINK = re.compile(r"!?\[[^\]]*\]\((?!https?:|mailto:)([^)\s]+)\)")


def prose(text: str) -> str:
    """Without code, in which brackets are no links and # begins no heading."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link in LINK.findall(prose(page.read_text())):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link} does not exist"
        if page.parent == DOCS:
            assert target.is_relative_to(DOCS), f"{page.name}: {link} is not part of the site"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link} has no such heading"


@pytest.mark.parametrize("path", sorted(DOCS.glob("notebooks/*.ipynb")), ids=lambda path: path.stem)
def test_links_of_notebooks(path):
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] == "markdown":
            for link in LINK.findall(prose("".join(cell["source"]))):
                assert (path.parent / link.partition("#")[0]).exists(), link


def test_every_picture_and_notebook_is_shown():
    linked = {(page.parent / link.partition("#")[0]).resolve() for page in PAGES for link in LINK.findall(page.read_text())}
    assert {*DOCS.glob("*.png"), *DOCS.glob("notebooks/*.ipynb")} <= linked


def test_every_page_is_in_the_navigation_once():
    nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2].partition("\nmarkdown_extensions:")[0]
    assert sorted(re.findall(r"([\w/]+\.md)$", nav, flags=re.MULTILINE)) == sorted(page.name for page in DOCS.glob("*.md"))


def test_every_public_name_is_in_the_reference_once():
    assert sorted(re.findall(r"^::: pdipc\.(\w+)$", (DOCS / "api.md").read_text(), flags=re.MULTILINE)) == sorted(pdipc.__all__)


def test_python_of_every_page_is_run():
    """Somewhere in the tests: each page that has any is named there."""
    tests = "".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py") if path != Path(__file__))
    for page in DOCS.glob("*.md"):
        if "```python" in page.read_text():
            assert f'"{page.stem}"' in tests or f'"{page.name}"' in tests, page.name


def test_every_benchmark_is_listed():
    listed = set(re.findall(r"`(\w+\.py)`", (DOCS / "benchmarks.md").read_text()))
    scripts = {path.name for path in (ROOT / "benchmarks").glob("*.py") if '__name__ == "__main__"' in path.read_text()}
    assert scripts <= listed <= {path.name for path in (ROOT / "benchmarks").glob("*.py")}


def test_lists_and_tables_have_space_above():
    """Without it the site, unlike GitHub, makes them part of the paragraph."""
    for page in DOCS.glob("*.md"):
        lines = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE).splitlines()
        for above, line in itertools.pairwise(lines):
            for begins, goes_on in ((r"(- |\d+\. )", r"(- |\d+\. | )"), (r"\|", r"\|")):
                if re.match(begins, line) and above.strip():
                    assert re.match(goes_on, above), f"{page.name}: no empty line above: {line}"


def test_the_site_builds(tmp_path):
    """Without a warning, and with each name where the reference is."""
    for package in ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers.python"):
        if importlib.util.find_spec(package.partition(".")[0]) is None or importlib.util.find_spec(package) is None:
            pytest.skip(f"needs {package} (extra: docs)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    reference = (tmp_path / "site" / "api" / "index.html").read_text()
    for name in pdipc.__all__:
        assert f'id="pdipc.{name}"' in reference, name
    assert "Raises" in reference and 'id="pdipc.Simulation.set_pose"' in reference
