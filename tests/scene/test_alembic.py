"""Alembic archives: meshes where they stand, outward, and over time; what is not taken is said, and what is damaged is refused."""

import sys

import numpy as np
import pytest

import pdipc
from pdipc.scene import assembly, check, generators, meshes
from pdipc.scene.errors import SceneError, SceneWarning
from pdipc.scene.frames import read_frames
from pdipc.scene.worker import Worker

imath = pytest.importorskip("imath", reason='the extra "alembic" is not installed')
alembic3d = pytest.importorskip("alembic3d", reason='the extra "alembic" is not installed')
Abc, AbcGeom = alembic3d.Abc, alembic3d.AbcGeom
RATE = 25.0
BOX = generators.Box(size=(1.0, 1.0, 1.0), cells=(2, 2, 2)).mesh().surface()


@pytest.fixture(scope="module")
def worker():
    """One process reads the files of all tests."""
    with Worker() as made:
        yield made


def array(kind, values):
    made = kind(len(values))
    np.asarray(made)[:] = values
    return made


class Writer:
    """An archive that is written; it is whole once the writer is gone."""

    def __init__(self, path, start=0.0, rate=RATE):
        self.archive = Abc.CreateArchiveWithInfo(str(path), "tests", "")
        self.top = self.archive.getTop()
        self.times = self.archive.addTimeSampling(alembic3d.AbcCoreAbstract.TimeSampling(1.0 / rate, start))

    def place(self, above, name, *matrices, inherits=True):
        """An Xform of one matrix for rows, or of one a frame."""
        made = AbcGeom.OXform(above, name, self.times if len(matrices) > 1 else 0)
        for matrix in matrices:
            sample = AbcGeom.XformSample()
            sample.setMatrix(imath.M44d(*np.asarray(matrix, dtype=float).ravel().tolist()))
            sample.setInheritsXforms(inherits)
            made.getSchema().set(sample)
        return made

    def mesh(self, above, name, *frames, faces=BOX.triangles, kind="PolyMesh", holes=None):
        """A mesh of polygons, counterclockwise seen from outside: written clockwise, as the format asks. frames: (n, 3) each; faces: of all, or a list of those of each."""
        made = getattr(AbcGeom, f"O{kind}")(above, name, self.times if len(frames) > 1 else 0)
        for number, points in enumerate(frames):
            own = faces[number] if isinstance(faces, list) else faces
            corners, counts = np.asarray(own)[:, ::-1], np.full(len(own), np.asarray(own).shape[1])
            given = [array(imath.V3fArray, points)]
            if number == 0 or isinstance(faces, list):
                given += [array(imath.IntArray, corners.ravel()), array(imath.IntArray, counts)]
            if holes is not None:  # after creases and corners, of which there are none
                ints, numbers = imath.IntArray(0), imath.FloatArray(0)
                given += [ints, ints, numbers, ints, numbers, array(imath.IntArray, holes)]
            made.getSchema().set(getattr(AbcGeom, f"O{kind}SchemaSample")(*given))
        return made

    def show(self, each, *values):
        """1 for visible, 0 for invisible; one value, or one a frame."""
        visible = AbcGeom.CreateVisibilityProperty(each, self.times if len(values) > 1 else 0)
        for value in values:
            visible.setValue(value)


def shift(x, y=0.0, z=0.0, scale=(1.0, 1.0, 1.0)):
    matrix = np.diag([*scale, 1.0])
    matrix[3, :3] = x, y, z
    return matrix


def volume(mesh):
    """m^3, positive where the triangles face outward."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return np.einsum("ij,ij->", np.cross(a, b), c) / 6


def hull(mesh):
    return [*mesh.vertices.min(axis=0), *mesh.vertices.max(axis=0)]


def test_meshes_stand_where_their_places_have_them_and_face_outward(tmp_path, worker):
    def write():
        to = Writer(tmp_path / "a.abc")
        world = to.place(to.top, "World", shift(10, 0, 0, scale=(2, 2, 2)))
        to.mesh(to.place(world, "Box", shift(1, 0, 0)), "BoxShape", BOX.vertices)
        to.mesh(to.place(world, "Mirrored", shift(0, 5, 0, scale=(-1, 1, 1))), "MirroredShape", BOX.vertices)
        to.mesh(to.place(world, "Alone", shift(0, 0, 7), inherits=False), "AloneShape", BOX.vertices)

    write()
    whole = meshes.read(tmp_path / "a.abc", worker)
    assert whole.notes == [] and len(whole.triangles) == 3 * len(BOX.triangles)
    assert volume(whole) == pytest.approx(8 + 8 + 1)
    box = meshes.read(f"{tmp_path}/a.abc</World/Box>", worker)
    assert hull(box) == pytest.approx([11, -1, -1, 13, 1, 1]), "p' = p Box World, the nearest first"
    assert volume(box) == pytest.approx(8)
    assert volume(meshes.read(f"{tmp_path}/a.abc</World/Mirrored/MirroredShape>", worker)) == pytest.approx(8), (
        "its outside stays its outside"
    )
    assert hull(meshes.read(f"{tmp_path}/a.abc</World/Alone>", worker)) == pytest.approx([-0.5, -0.5, 6.5, 0.5, 0.5, 7.5])


def test_an_instance_is_a_mesh_of_its_own(tmp_path, worker):
    def write():
        to = Writer(tmp_path / "a.abc")
        box = to.place(to.top, "Box", shift(1))
        to.mesh(box, "Shape", BOX.vertices)
        to.place(to.top, "Other", shift(10)).addChildInstance(box, "Twin")

    write()
    assert volume(meshes.read(tmp_path / "a.abc", worker)) == pytest.approx(2)
    assert hull(meshes.read(f"{tmp_path}/a.abc</Other/Twin>", worker))[::3] == pytest.approx([10.5, 11.5])


def test_what_is_not_taken_is_said(tmp_path, worker):
    def write():
        to = Writer(tmp_path / "a.abc")
        to.mesh(to.top, "box", BOX.vertices)
        to.show(to.mesh(to.top, "hidden", BOX.vertices), 0)
        below = to.place(to.top, "below", np.eye(4))
        to.show(below, 0)
        to.mesh(below, "hidden_too", BOX.vertices)
        to.show(to.mesh(below, "shown", BOX.vertices + np.array([0, 3, 0])), 1)
        to.show(to.mesh(to.top, "blinking", BOX.vertices + np.array([3, 0, 0])), 1, 0)
        quad = np.array([[0, 1, 2, 3], [3, 2, 5, 4]])
        points = np.array([[0, 9, 0], [1, 9, 0], [1, 9, -1], [0, 9, -1], [0, 9, -2], [1, 9, -2]])
        to.mesh(to.top, "cage", points, faces=quad, kind="SubD", holes=[1])
        AbcGeom.OPolyMesh(to.top, "empty")
        AbcGeom.OCurves(to.top, "hair")
        AbcGeom.OPoints(to.top, "dust")
        AbcGeom.OCamera(to.top, "camera")
        AbcGeom.OCamera(to.top, "camera2")

    write()
    mesh = meshes.read(tmp_path / "a.abc", worker)
    assert len(mesh.triangles) == 3 * len(BOX.triangles) + 2
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    normals = np.cross(b - a, c - a)[a[:, 1] == 9]
    assert np.all(normals[:, 1] > 0), "what was written clockwise seen from above faces up"
    assert mesh.notes == [
        "objects were left out: 2 Camera, 1 Curve, 1 Points, 1 PolyMesh without points",
        "2 invisible objects were left out",
        "1 subdivision surfaces were taken as their cages",
        "1 meshes appear or vanish with time: they were taken as at the start",
    ]
    with pytest.raises(SceneError, match=r"its object /camera holds no mesh; objects were left out: 1 Camera"):
        meshes.read(f"{tmp_path}/a.abc</camera>", worker)
    with pytest.raises(
        SceneError, match=r'has no object "/boxx"; did you mean "/box"\? its meshes are: /box, /hidden, /below/hidden_too'
    ):
        meshes.read(f"{tmp_path}/a.abc</boxx>", worker)


WAVE = np.stack([BOX.vertices * [1, 1 + 0.5 * k, 1] for k in range(5)])


def moving(path, start=1.0):
    to = Writer(path, start)
    to.mesh(to.top, "deforming", *WAVE)
    turns = [[[np.cos(a), 0, -np.sin(a), 0], [0, 1, 0, 0], [np.sin(a), 0, np.cos(a), 0], [5, 0, 0, 1]] for a in (0.0, 0.3, 0.6)]
    to.mesh(to.place(to.place(to.top, "still", shift(0, 1, 0)), "turning", *turns), "shape", BOX.vertices)
    to.mesh(to.top, "static", BOX.vertices - 5.0)
    return np.array(turns)


def test_frames_are_the_samples_of_points_and_of_places(tmp_path, worker):
    turns = moving(tmp_path / "a.abc")
    frames, _ = read_frames(f"{tmp_path}/a.abc</deforming>", None, worker)
    assert frames.times == pytest.approx(np.arange(5) / RATE), "the archive's start, 1 s, is the obstacle's start"
    assert frames.points == pytest.approx(WAVE)
    frames, _ = read_frames(f"{tmp_path}/a.abc</still>", None, worker)
    assert frames.times == pytest.approx(np.arange(3) / RATE)
    assert frames.points == pytest.approx(np.stack([BOX.vertices @ m[:3, :3] + m[3, :3] + [0, 1, 0] for m in turns]))
    frames, first = read_frames(f"{tmp_path}/a.abc", 10.0, worker)
    assert frames.times == pytest.approx(np.arange(5) / 10), "a rate that is given is the scene's"
    size = len(BOX.vertices)
    assert frames.points[:, 2 * size :] == pytest.approx(np.stack([BOX.vertices - 5.0] * 5)), (
        "what stands still is in every frame"
    )
    assert frames.points[4, size : 2 * size] == pytest.approx(frames.points[2, size : 2 * size]), "the last sample stays"
    assert first.notes == []
    assert meshes.read(tmp_path / "a.abc", worker).notes == [
        "it moves or deforms at 5 times: it was read as it is at the start"
    ]
    with pytest.raises(SceneError, match=r"holds one frame only; needed: several, .* in USD and Alembic as time samples"):
        read_frames(f"{tmp_path}/a.abc</static>", None, worker)


def test_samples_of_other_rates_go_straight_and_start_together(tmp_path, worker):
    def write():
        to = Writer(tmp_path / "a.abc", start=0.0)
        fine = to.archive.addTimeSampling(alembic3d.AbcCoreAbstract.TimeSampling(0.5 / RATE, 1.0 / RATE))
        coarse = to.place(to.top, "coarse", shift(0), shift(1), shift(2))
        to.times = fine
        to.mesh(coarse, "fine", *WAVE[:3])

    write()
    frames, _ = read_frames(f"{tmp_path}/a.abc</coarse/fine>", None, worker)
    assert frames.times * RATE == pytest.approx([0, 1, 1.5, 2])
    assert frames.points[:, :, 0] == pytest.approx(BOX.vertices[:, 0] + np.array([[0], [1], [1.5], [2]]))
    assert frames.points[:, :, 1] == pytest.approx(WAVE[[0, 0, 1, 2], :, 1]), "before its first sample it is as there"


def test_an_obstacle_deforms_as_an_archive_says(tmp_path):
    moving(tmp_path / "a.abc")
    (tmp_path / "a.toml").write_text(
        '[[bodies]]\nname = "c"\nkind = "cloth"\nmesh = { shape = "grid", cells = [8, 8] }\ntranslation = [0, 4, 0]\n'
        '[[obstacles]]\nname = "o"\nmesh = "a.abc</deforming>"\ntranslation = [0, 1, 0]\nmotion = { cache = "a.abc</deforming>", start = 2.0 }\n'
    )
    given = pdipc.load_scene(tmp_path / "a.toml")
    assert check.check(given) == []
    made = assembly.assemble(given)
    assert made.kinematic_positions(2.0 + 1.5 / RATE) == pytest.approx(0.5 * (WAVE[1] + WAVE[2]) + [0, 1, 0])
    given.obstacles[0].motion = None
    with pytest.warns(SceneWarning, match='obstacle "o": it moves or deforms at 5 times'):
        assembly.assemble(given)


def test_faces_that_change_are_no_cache(tmp_path, worker):
    def write():
        to = Writer(tmp_path / "a.abc")
        to.mesh(to.top, "fluid", BOX.vertices, BOX.vertices + 1, faces=[BOX.triangles, BOX.triangles[:-1]])
        to.mesh(
            to.top,
            "drops",
            BOX.vertices,
            BOX.vertices[1:],
            faces=[BOX.triangles, BOX.triangles[BOX.triangles.min(axis=1) > 0] - 1],
        )
        to.mesh(to.top, "alike", BOX.vertices, BOX.vertices + 1, faces=[BOX.triangles, BOX.triangles])

    write()
    assert meshes.read(f"{tmp_path}/a.abc</fluid>", worker).notes == [
        "it moves or deforms at 2 times: it was read as it is at the start",
        "the faces of 1 meshes change with time: they were read as they are at the start",
    ]
    for name in ("fluid", "drops"):
        with pytest.raises(
            SceneError, match=f'mesh "/{name}" has other faces at 0.04 s than at the start; what deforms must keep its own'
        ):
            read_frames(f"{tmp_path}/a.abc</{name}>", None, worker)
    assert len(read_frames(f"{tmp_path}/a.abc</alike>", None, worker)[0].points) == 2


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\x89HDF\r\n\x1a\n" + b"\x00" * 100, "archive of the old kind, HDF5; write it as Ogawa"),
        (b"hello", "it is no Alembic archive"),
        (b"", "it is no Alembic archive"),
        (b"Ogawa\x00\x00\x01" + b"\x00" * 100, "it was not written to its end"),
    ],
)
def test_files_that_are_no_archives_are_refused(tmp_path, data, says, worker):
    (tmp_path / "a.abc").write_bytes(data)
    with pytest.raises(SceneError, match=rf"a\.abc.*: cannot be read as \.abc: .*{says}"):
        meshes.read(tmp_path / "a.abc", worker)


def test_faces_that_name_no_vertex_are_refused(tmp_path, worker):
    def write(faces):
        to = Writer(tmp_path / "a.abc")
        to.mesh(to.top, "a", BOX.vertices, faces=faces)

    write(np.array([[0, 1, 99]]))
    with pytest.raises(SceneError, match=r'mesh "/a" names a vertex that is not there; indices must be 0 to 25'):
        meshes.read(tmp_path / "a.abc", worker)


def test_without_the_extra_one_message_names_it(tmp_path, monkeypatch):
    moving(tmp_path / "a.abc")
    monkeypatch.setitem(sys.modules, "alembic3d", None)
    monkeypatch.setattr(Worker, "_start", lambda self: False)  # the file is read in this process
    with pytest.raises(SceneError, match=r'reading Alembic needs the extra: pip install "pdipc\[alembic\]"'):
        meshes.read(tmp_path / "a.abc")


def test_damaged_archives_are_read_or_refused_in_our_words(tmp_path, worker):
    """300 archives with bytes that are flipped, lost, doubled, overwritten or cut off: no foreign error, and the process that reads them may end."""
    moving(tmp_path / "good.abc")
    good, rng, refused = (tmp_path / "good.abc").read_bytes(), np.random.default_rng(1), 0
    for number in range(300):
        data, at, many = bytearray(good), int(rng.integers(8, len(good))), int(rng.integers(1, 64))
        match number % 5:
            case 0:
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                data[at : at + many] = rng.bytes(many)
            case 2:
                del data[at : at + many]
            case 3:
                del data[at:]
            case _:
                data[at:at] = data[at : at + many]
        path = tmp_path / "bad.abc"
        path.write_bytes(data)
        try:
            if number % 2:
                assert np.isfinite(read_frames(str(path), None, worker)[0].points).all()
            else:
                assert len(meshes.read(path, worker).triangles)
        except SceneError as error:
            refused += 1
            assert "bad.abc" in str(error) and "Traceback" not in str(error) and "\n" not in str(error)
    assert 100 < refused < 300
