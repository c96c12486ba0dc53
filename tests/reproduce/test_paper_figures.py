"""Figures 2 to 5 and the table of modes, in their small sizes: what they draw is measured, and says what the documents say."""

import csv

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="figures need matplotlib (extra: pictures)")
pytest.importorskip("ipctk", reason="the baselines need ipctk (extra: benchmarks)")

from pdipc.reproduce import fig2, fig3, fig4, fig5, modes


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def drawn(picture):
    """The picture is there, beside its numbers and its sentence."""
    assert picture.stat().st_size > 10_000
    assert len(picture.with_suffix(".txt").read_text()) > 100
    return table(picture.with_suffix(".csv"))


def test_fig2(tmp_path):
    rows = drawn(fig2.run(tmp_path, small=True))
    heights = {
        name: np.array([float(r["height"]) for r in rows if r["method"] == name]) for name in {r["method"] for r in rows}
    }
    assert len(heights) == 6
    assert heights["vanilla PD"].min() < 0.0  # through the plane
    assert heights["PD + CCD"].min() > 0.0
    assert heights["PD + CCD"][-1] < 1e-4  # and sticks
    assert heights["pdipc, restitution 0.5"].min() > 0.0
    assert heights["pdipc, restitution 0.5"][6:].max() == pytest.approx(1.1**2 / 2 / 9.81, rel=0.1)  # v^2 / 2 g


def test_fig3(tmp_path):
    rows = [r for r in drawn(fig3.run(tmp_path, small=True)) if r["against"] == "restitution"]
    error = {
        m: max(abs(float(r["rebound"]) - float(r["value"])) for r in rows if r["method"] == m)
        for m in {r["method"] for r in rows}
    }
    assert error["default mode"] < 0.02
    assert error["paper mode"] > 0.3


@pytest.mark.parametrize("figure", [fig4, fig5])
def test_fig4_and_5(figure, tmp_path):
    rows = drawn(figure.run(tmp_path, small=True))
    ways = {way: [r for r in rows if r["way"] == way] for way in {r["way"] for r in rows}}
    assert len(ways) == 3
    for way, own in ways.items():
        ends = [int(r["iteration"]) for r in own if r["outer"] == "1"]
        assert [int(r["iteration"]) for r in own] == list(range(1, len(own) + 1))
        if way.startswith("truncated"):
            assert ends == list(range(1, len(own) + 1))
        else:
            assert 1 < len(ends) < len(own)
    default = [float(r["potential"]) for r in ways["default mode"]]
    assert default[-1] < max(default)
    assert float(ways["default mode"][-1]["height"]) > 0.0


def test_modes(tmp_path):
    rows = {(r["scene"], r["mode"]): r for r in drawn(modes.run(tmp_path, small=True))}
    assert len(rows) == 9
    slides, collide = rows["box slides", "default"], rows["two boxes collide", "default"]
    assert float(slides["distance to IPC"]) < 1e-3
    assert float(rows["box slides", "paper"]["distance to IPC"]) > 10 * float(slides["distance to IPC"])
    assert float(collide["momentum error"]) < 1e-5
    assert float(rows["two boxes collide", "paper"]["momentum error"]) > 100 * float(collide["momentum error"])
    assert (tmp_path / "modes.md").read_text().count("\n") == 11
