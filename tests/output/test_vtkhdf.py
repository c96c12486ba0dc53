"""run.vtkhdf holds the frames of the run, as VTK itself reads it, whatever happened to the run or to the file."""

import fcntl
import multiprocessing
import os
import shutil
import signal

import h5py
import numpy as np
import pytest

import pdipc
from pdipc.output.results import RunWriter, open_run
from tests.output import runs

vtk_io = pytest.importorskip("vtkmodules.vtkIOHDF")
TETRA, TRIANGLE = 10, 5  # VTK's numbers


def reader_of(path):
    reader = vtk_io.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    return reader


def times_of(reader) -> list[float]:
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline

    information = reader.GetOutputInformation(0)
    return [information.Get(Pipeline.TIME_STEPS(), i) for i in range(information.Length(Pipeline.TIME_STEPS()))]


def as_vtk_reads(path):
    """The times, and the mesh at each: what ParaView asks of the reader."""
    pyvista = pytest.importorskip("pyvista")
    reader = reader_of(path)
    times, meshes = times_of(reader), []
    for time in times:
        reader.UpdateTimeStep(time)
        meshes.append(pyvista.wrap(reader.GetOutput()).copy())
    return times, meshes


def assert_holds(folder, frames: int) -> None:
    """The file has the first frames of the run, each in full."""
    run = open_run(folder)
    times, meshes = as_vtk_reads(folder / "run.vtkhdf")
    assert len(times) == frames
    np.testing.assert_array_equal(times, run.times[:frames])
    surface = run.triangles[run.body_of_triangle > 0]
    for frame, mesh in enumerate(meshes):
        np.testing.assert_array_equal(mesh.points, run.positions(frame))
        assert mesh.n_cells == len(run.tets) + len(surface)
        np.testing.assert_array_equal(mesh.cells_dict[TETRA], run.tets)
        np.testing.assert_array_equal(mesh.cells_dict[TRIANGLE], surface)
        of_vertex = run.topology["body_of_vertex"]
        bodies = np.concatenate([of_vertex[run.tets[:, 0]], of_vertex[surface[:, 0]]])
        np.testing.assert_array_equal(mesh.cell_data["body"], bodies)


def dies_while_appending(folder) -> None:
    """Goes on for two steps and is killed while the second of them is put into the file."""
    writer = RunWriter.resume(folder)
    step, arrays = writer.latest_checkpoint()
    load = np.load

    def load_until_killed(path):
        if path.stem == f"{step + 2:06d}":
            os.kill(os.getpid(), signal.SIGKILL)
        return load(path)

    np.load = load_until_killed
    runs.advance(writer, arrays["positions"], range(step + 1, step + 3))


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_every_step_is_the_frame(tmp_path, precision):
    runs.write(tmp_path / "run", steps=5, precision=precision)
    assert_holds(tmp_path / "run", 5)  # the last checkpoint was after step 4
    RunWriter.resume(tmp_path / "run")
    assert_holds(tmp_path / "run", 5)
    points = np.stack([mesh.points for mesh in as_vtk_reads(tmp_path / "run/run.vtkhdf")[1]])
    assert np.diff(points, axis=0).any(axis=(1, 2)).all()  # every step moves, or the wrong one would pass for the right one
    assert points.dtype == precision


def test_cells_are_stored_once(tmp_path):
    runs.write(tmp_path / "run", steps=8)
    run = open_run(tmp_path / "run")
    with h5py.File(tmp_path / "run/run.vtkhdf") as file:
        root = file["VTKHDF"]
        assert len(root["Types"]) == len(root["CellData/body"]) == len(run.tets) + np.sum(run.body_of_triangle > 0)
        assert len(root["Points"]) == 9 * len(run.positions(0))
        assert root["Points"].chunks == run.positions(0).shape


def test_appending_reads_only_what_is_new(tmp_path):
    writer, state = runs.begin(tmp_path / "run")
    state = runs.advance(writer, state, range(1, 3))
    start = tmp_path / "run/frames/000000.npy"
    start.rename(tmp_path / "start.npy")
    runs.advance(writer, state, range(3, 5))
    (tmp_path / "start.npy").rename(start)
    assert_holds(tmp_path / "run", 5)


@pytest.mark.parametrize("damage", ["garbage", "cut", "empty", "missing", "another run", "checkpoint"])
def test_resuming_mends_the_file(tmp_path, damage):
    runs.write(tmp_path / "whole", steps=8)
    folder = tmp_path / "killed"
    writer, state = runs.begin(folder)
    runs.advance(writer, state, range(1, 6))  # checkpoints after 2 and 4
    writer.close()
    path = folder / "run.vtkhdf"
    if damage == "garbage":
        path.write_bytes(bytes(range(256)) * 100)
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[:-1000])
    elif damage == "empty":
        path.unlink()
        h5py.File(path, "w").close()
    elif damage == "missing":
        path.unlink()
    elif damage == "another run":  # of the same times, and not quite the same positions
        runs.write(tmp_path / "another", steps=4, precision="float64")
        shutil.copy(tmp_path / "another/run.vtkhdf", path)
    elif damage == "checkpoint":  # the run goes back to step 2, which the file has passed
        (folder / "checkpoints/000004.npz").write_bytes(b"")

    writer = RunWriter.resume(folder)
    step, arrays = writer.latest_checkpoint()
    assert_holds(folder, step + 1)
    runs.advance(writer, arrays["positions"], range(step + 1, 9))
    assert_holds(folder, 9)
    for mesh, uninterrupted in zip(as_vtk_reads(path)[1], as_vtk_reads(tmp_path / "whole/run.vtkhdf")[1], strict=True):
        np.testing.assert_array_equal(mesh.points, uninterrupted.points)


def test_a_file_half_written_by_a_killed_run_is_noticed(tmp_path):
    folder = tmp_path / "run"
    runs.write(folder, steps=4)
    killed = multiprocessing.get_context("spawn").Process(target=dies_while_appending, args=(folder,))
    killed.start()
    killed.join()
    assert killed.exitcode == -signal.SIGKILL
    with pytest.raises(OSError):
        h5py.File(folder / "run.vtkhdf")
    RunWriter.resume(folder)
    assert_holds(folder, 7)


def test_an_interrupted_append_leaves_the_steps_there_were(tmp_path, monkeypatch):
    writer, state = runs.begin(tmp_path / "run")
    state = runs.advance(writer, state, range(1, 3))

    load = np.load

    def load_until_interrupted(path):
        if path.stem == "000004":
            raise KeyboardInterrupt
        return load(path)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(np, "load", load_until_interrupted)
        runs.advance(writer, state, range(3, 5))
    assert_holds(tmp_path / "run", 3)
    writer.close()
    RunWriter.resume(tmp_path / "run").close()
    assert_holds(tmp_path / "run", 5)


def test_the_run_goes_on_while_the_file_is_watched(tmp_path):
    writer, state = runs.begin(tmp_path / "run")
    state = runs.advance(writer, state, range(1, 3))
    path = tmp_path / "run/run.vtkhdf"
    watching = reader_of(path)
    watching.Update()
    file = path.stat().st_ino
    with open(path, "rb") as held:
        fcntl.flock(held, fcntl.LOCK_SH)  # as readers do that keep the file open
        state = runs.advance(writer, state, range(3, 5))
    assert path.stat().st_ino == file  # appended to, not replaced
    assert_holds(tmp_path / "run", 5)
    with h5py.File(path):  # in the same process HDF5 refuses to write: the file is replaced
        runs.advance(writer, state, range(5, 7))
    assert_holds(tmp_path / "run", 7)
    assert len(times_of(watching)) == 3


def test_overwriting_removes_it(tmp_path):
    runs.write(tmp_path / "run", steps=4)
    _, topology = runs.parts()
    RunWriter.create(tmp_path / "run", "{}", topology, {}, overwrite=True)
    assert not (tmp_path / "run/run.vtkhdf").exists()


def test_an_interrupted_simulation_has_all_its_steps_in_the_file(tmp_path):
    def stop(info) -> None:
        if info.step == 2:
            raise KeyboardInterrupt

    scene, folder = pdipc.Scene(**runs.scene()), tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        pdipc.run_scene(scene, folder, steps=4, device="cpu", progress=stop)
    assert_holds(folder, 3)
    pdipc.run_scene(scene, folder, steps=4, device="cpu", resume=True)
    assert_holds(folder, 5)
