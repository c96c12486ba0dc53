"""Point caches: every byte of a frame is where their formats say, and the numbers are the run's."""

import numpy as np
import pytest

from pdipc.export.export import export
from pdipc.output.results import open_run
from tests.output import runs


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    runs.write(folder, steps=3)
    return open_run(folder)


def mesh_of(folder, name):
    lines = [line.split() for line in (folder / f"{name}.obj").read_text().splitlines()]
    vertices = np.array([[float(x) for x in words[1:]] for words in lines if words[0] == "v"])
    return vertices, np.array([[int(x) for x in words[1:]] for words in lines if words[0] == "f"]) - 1


def read_mdd(path):
    data = path.read_bytes()
    frames, points = np.frombuffer(data, ">i4", 2)
    times = np.frombuffer(data, ">f4", frames, 8)
    return times, np.frombuffer(data, ">f4", offset=8 + 4 * frames).reshape(frames, points, 3)


def read_pc2(path):
    data = path.read_bytes()
    assert data[:12] == b"POINTCACHE2\0"
    version, points = np.frombuffer(data, "<i4", 2, 12)
    start, sampling = np.frombuffer(data, "<f4", 2, 20)
    (frames,) = np.frombuffer(data, "<i4", 1, 28)
    assert (version, start, sampling) == (1, 0.0, 1.0)
    return np.frombuffer(data, "<f4", offset=32).reshape(frames, points, 3)


@pytest.mark.parametrize("kind", ["mdd", "pc2"])
def test_caches_hold_the_run(run, tmp_path, kind):
    folder = export(run, kind, tmp_path / "out")
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"{name}.{suffix}" for name in ("ball", "cloth", "floor") for suffix in (kind, "obj")
    )
    for body, name in enumerate(run.body_names):
        vertices, triangles = run.skins[body].sources, run.skins[body].triangles
        start, faces = mesh_of(folder, name)
        np.testing.assert_array_equal(start, run.positions(0)[vertices])
        np.testing.assert_array_equal(faces, triangles)
        if kind == "mdd":
            times, points = read_mdd(folder / f"{name}.mdd")
            np.testing.assert_array_equal(times, run.times.astype(np.float32))
        else:
            points = read_pc2(folder / f"{name}.pc2")
        assert len(points) == run.frame_count
        for frame in range(run.frame_count):
            np.testing.assert_array_equal(points[frame], run.positions(frame)[vertices].astype(np.float32))


def test_names_that_files_cannot_have(run, tmp_path):
    run.topology["body_names"] = np.array(["a/b", "a:b", "floor"])
    del run.__dict__["body_names"]
    folder = export(run, "mdd", tmp_path / "out")
    assert sorted(path.name for path in folder.glob("*.mdd")) == ["0_a_b.mdd", "1_a_b.mdd", "2_floor.mdd"]
