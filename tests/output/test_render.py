"""Pictures show the bodies: framed, in their colours, and moving where the run moves."""

import numpy as np
import pytest

from pdipc.output.results import open_run
from tests.output import runs

pytest.importorskip("pyvista", reason="needs pyvista (extra: pictures)")
imageio = pytest.importorskip("imageio.v3", reason="needs imageio (extra: pictures)")

SIZE = (160, 100)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    runs.write(folder, steps=4)
    return open_run(folder)


def share(picture: np.ndarray, channel: int) -> np.ndarray:
    """(height, width) bool: pixels in which one colour channel clearly stands out."""
    values = picture[..., :3].astype(int)
    return values[..., channel] > np.delete(values, channel, axis=-1).min(axis=-1) + 60


def test_a_still_shows_all_bodies_in_the_middle(run, tmp_path):
    from pdipc.output.render import render

    render(run, 0, tmp_path / "deep/picture.png", size=SIZE)
    picture = imageio.imread(tmp_path / "deep/picture.png")
    assert picture.shape[:2] == (SIZE[1], SIZE[0])
    blue, red = share(picture, 2), share(picture, 0)  # the ball, the cloth
    assert blue.mean() > 0.01
    assert red.mean() > 0.05
    rows, columns = np.nonzero(blue | red)
    assert 0.25 * SIZE[0] < columns.mean() < 0.75 * SIZE[0]
    # the bodies fill the picture although the floor is forty times their size, and none is cut off
    assert np.ptp(columns) > 0.4 * SIZE[0] or np.ptp(rows) > 0.4 * SIZE[1]
    assert min(columns.min(), rows.min()) > 0
    assert columns.max() < SIZE[0] - 1
    assert rows.max() < SIZE[1] - 1


def test_an_animation_has_a_frame_for_every_second_step(run, tmp_path):
    from pdipc.output.render import render_animation

    render_animation(run, tmp_path / "run.gif", every=2, size=SIZE)
    assert len(imageio.imread(tmp_path / "run.gif", index=None)) == 3
