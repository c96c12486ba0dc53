"""The page on USD and Blender: its scene, its commands and its programs, in order, in an empty folder."""

import re
import shlex
import struct
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pdipc.cli import app

pytest.importorskip("pxr.Usd")

PAGE = Path(__file__).parents[2] / "docs" / "usd_and_blender.md"


def test_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    text = PAGE.read_text()
    for block in re.finditer(r"```(\w+)\n(.*?)```", text, flags=re.DOTALL):
        kind, body = block.groups()
        if kind == "toml":
            Path("scene.toml").write_text(body)
        elif kind == "python":
            above = text[: block.start(2)].count("\n")
            exec(compile("\n" * above + body, str(PAGE), "exec"), names)
        else:
            for line in body.splitlines():
                result = CliRunner().invoke(app, shlex.split(line.partition("#")[0])[1:])
                assert result.exit_code == 0, f"{line}: {result.stderr}"
    assert struct.unpack(">ii", Path("caches/flag.mdd").read_bytes()[:8]) == (5, 25)
