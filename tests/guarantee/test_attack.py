"""A scene of each newer kind of `benchmarks/attack.py`, as far as a second takes it; and its judge, where nothing is proven."""

import sys
from pathlib import Path

import pytest

from pdipc.collision.truncation import Truncation

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
attack = pytest.importorskip("attack")


def outcome(name, number, monkeypatch):
    monkeypatch.setattr(attack, "SECONDS", 1.0)
    monkeypatch.setattr(attack, "MOTIONS", 30)
    (family,) = (each for each in attack.FAMILIES if each.__name__ == name)
    return attack.attack(family, number, 6)


@pytest.mark.filterwarnings("ignore::pdipc.scene.errors.SceneWarning")
@pytest.mark.parametrize("name", ["commanded", "put_anew", "quarantined", "deforming_obstacles"])
def test_no_breach(name, monkeypatch):
    found = outcome(name, 1, monkeypatch)
    assert found["motions"] > 0 and not found["refused"] and not found["breaches"]


def test_what_is_not_proven_is_judged(monkeypatch):
    """Without CCD things pass through each other, and the judge says where."""
    monkeypatch.setattr(Truncation, "prove", lambda *_: None)
    assert any("meets" in breach for breach in outcome("deforming_obstacles", 1, monkeypatch)["breaches"])
    assert outcome("ropes", 1, monkeypatch)["breaches"]
