"""The certificate: what passes through is found, what stays apart is not accused, and a broken record is refused."""

import numpy as np
import pytest

from pdipc.judge.certify import certify
from pdipc.output.results import RunError, open_run
from tests.output import runs

pytest.importorskip("ipctk", reason="needs ipctk (extra: witness)")


def cloth_moved(folder, *heights: float):
    """A run of one step in which the cloth's motion passes the given heights, m; the ball reaches up to 0.55."""
    writer, state = runs.begin(folder)
    cloth = state[:, 1] > 0.58
    for outer, height in enumerate(heights):
        end = state.copy()
        end[cloth, 1] = height
        writer.append_segments(1, outer, state, end)
        state = end
    writer.append(1, 0.01, state, {})
    return open_run(folder)


def test_a_motion_through_a_body_is_a_hit_though_all_frames_are_clean(tmp_path):
    run = cloth_moved(tmp_path / "run", 0.56, 0.02)  # ends below the ball
    certificate = certify(run)
    assert certificate.segments == 2
    assert certificate.hits
    assert {(hit.step, hit.outer) for hit in certificate.hits} == {(1, 1)}
    assert all('"ball"' in hit.what and '"cloth"' in hit.what for hit in certificate.hits)
    assert min(hit.toi for hit in certificate.hits) == pytest.approx((0.56 - 0.55) / (0.56 - 0.02), abs=1e-3)


def test_coming_very_close_is_no_hit_and_is_measured(tmp_path):
    top = runs.begin(tmp_path / "start")[1]
    ball = top[: np.flatnonzero(top[:, 1] > 0.58)[0], 1].max()
    height = np.float32(ball + 1e-5)
    certificate = certify(cloth_moved(tmp_path / "run", 0.57, float(height)))
    assert certificate.hits == []
    assert certificate.pairs > 0
    assert certificate.smallest_gap == pytest.approx(float(height) - float(ball), rel=1e-6)


def test_nearer_than_the_first_judge_can_tell_is_decided_exactly(tmp_path):
    """A slanted cloth that comes 1e-12 m near the ball is no hit though Tight Inclusion accuses it; 1e-12 m too far is one."""
    slope = np.array([0.2, 0.1])
    for name, gap in (("near", 1e-12), ("too far", -1e-12)):
        writer, start = runs.begin(tmp_path / name)
        end = start.astype(np.float64)
        cloth, ball = end[:, 1] > 0.58, end[: np.flatnonzero(end[:, 1] > 0.58)[0]]
        end[cloth, 1] = (ball[:, 1] + ball[:, [0, 2]] @ slope).max() + gap - end[cloth][:, [0, 2]] @ slope
        writer.append_segments(1, 0, start, end)
        writer.append(1, 0.01, end, {})
        certificate = certify(open_run(tmp_path / name))
        assert bool(certificate.hits) == (gap < 0)
        assert gap < 0 or certificate.close > 0


def test_obstacles_may_meet_each_other(tmp_path):
    run = cloth_moved(tmp_path / "run", 0.02)
    run.obstacle[:] = True
    certificate = certify(run)
    assert (certificate.pairs, certificate.hits) == (0, [])


def test_a_broken_record_is_refused(tmp_path):
    runs.write(tmp_path / "run", steps=4)
    told = []
    certificate = certify(open_run(tmp_path / "run"), progress=lambda *done: told.append(done))
    assert (certificate.segments, certificate.hits) == (4, [])
    assert told == [(1, 1), (2, 2), (3, 3), (4, 4)]
    (tmp_path / "run/segments/000002_0000.npz").unlink()
    with pytest.raises(RunError, match="broken at step 3"):
        certify(open_run(tmp_path / "run"))

    writer, state = runs.begin(tmp_path / "without")
    writer.append(1, 0.01, state, {})
    with pytest.raises(RunError, match="--certify"):
        certify(open_run(tmp_path / "without"))

    run = cloth_moved(tmp_path / "other", 0.57)
    np.save(run.folder / "frames/000001.npy", run.positions(1) + 1e-3)
    with pytest.raises(RunError, match="last frame"):
        certify(run)
