"""Line searches that CCD interferes with, and what rounding leaves: scenes of benchmarks/converge.py that once ended at the cap."""

from pathlib import Path

import pytest

import pdipc

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize(
    ("seed", "steps"),
    [
        (3, 5),  # a cloth of 7 mm: CCD cut the halved step again, unevenly, and no further half of that descended
        (19, 9),  # float32, 235 MPa: forces of rounding moved nothing that the potential showed
    ],
)
def test_every_step_converges(seed, steps, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import converge

    simulation = pdipc.Simulation(converge.draw(seed), "cpu")
    for _ in range(steps):
        result = simulation.step()
        assert result.converged, result.message
