"""The page's program runs as it stands there."""

import re
from pathlib import Path

import pytest

pytest.importorskip("newton")

PAGE = Path(__file__).parents[2] / "docs" / "newton.md"


def test_the_page():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    names: dict = {}
    exec(compile(code, str(PAGE), "exec"), names)
    q = names["state"].particle_q.numpy()
    table = names["state"].body_q.numpy()[0, 0]
    assert 0.03 < q[:, 0].mean() <= table + 1e-3, "friction takes the cloth along with the table"
    assert q[60, 2] > 0.3 and q[:, 2].min() < 0.25, "it lies on the table, and its rim hangs"
