"""A type checker passes on the Python of the README and of the tutorial, with its usual rules, so that an editor helps who writes such code."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js, which pyright runs on")
def test_python_of_the_readme_and_the_tutorial(tmp_path):
    pytest.importorskip("pyright")
    for page in ("README", "docs/tutorial"):
        text = (ROOT / f"{page}.md").read_text()
        blocks = re.finditer(r"```python\n(.*?)```", text, flags=re.DOTALL)
        code = ""
        for block in blocks:  # at the lines of the page, so that an error names one
            code += "\n" * (text[: block.start(1)].count("\n") - code.count("\n")) + block[1]
        (tmp_path / f"{Path(page).name.lower()}.py").write_text(code)
    wrong = tmp_path / "wrong.py"
    wrong.write_text('import pdipc\n\npdipc.load_scene("cloth_on_sphere").simulation.steps = "ten"\n')
    settings = {"include": ["."], "extraPaths": [str(ROOT / "src")], "typeCheckingMode": "standard"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "-p", str(tmp_path)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)
    assert found["summary"]["filesAnalyzed"] == 3
    errors = [each for each in found["generalDiagnostics"] if each["severity"] == "error"]
    own = [each for each in errors if Path(each["file"]).name == "wrong.py"]
    assert len(own) == 1, "types of the package are not seen"
    assert [
        f"{Path(each['file']).stem}:{each['range']['start']['line'] + 1}: {each['message']}"
        for each in errors
        if each not in own
    ] == []
