"""Damaged scenes and mesh files, by the thousand: `python benchmarks/fuzz.py --inputs 10000 --seed 1 --seconds 3600`.

Good scenes (TOML, JSON, Python) and good meshes of every format that is read are damaged by mutation: bytes that are flipped, lost,
doubled or cut off, words in place of others, values of other kinds, numbers without measure. Whatever comes of it must be read, or be
refused by the package's own error: any other exception is foreign, and what takes longer than LIMIT is a hang. Some of the scenes
that are found good are simulated for a step. Prints what was found, writes it to benchmarks/results/fuzz.json, and ends with exit code 1 where there was
a foreign error or a hang; --keep DIR keeps those inputs.

Each input follows from the seed and its number alone: `--only NUMBER` makes it again.
"""

import argparse
import collections
import contextlib
import copy
import datetime
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np
from ccd import machine

import pdipc
from pdipc.scene import check, generators, meshes, worker
from pdipc.scene.errors import SceneError
from pdipc.scene.frames import read_frames

CACHES = (".npz", ".usda", ".usdc", ".abc")  # formats that hold frames
LIMIT = 60  # s of work on one input; ten times as long may pass by the clock, where the machine is busy
OUTCOMES = ("read", "simulated", "refused", "foreign", "hang")
STEPPED = 20  # one in so many of the scenes that are found good is simulated for a step
worker.SECONDS = 2.0  # for the damaged files on which parsers of other packages never end

HOSTILE_WORDS = [
    b"nan", b"inf", b"-1", b"0", b"1e308", b"1e-200", b"1" * 400, b"9" * 5000, b"18446744073709551616", b"2147483648", b"-2147483649",
    b'""', b"true", b"1979-05-27", b"[", b"{", b"[" * 3000, b"\x00", b"\xff\xfe", "\u2028".encode(), b"x" * 5000, b"1e5", b"-", b".", b"#",
]  # fmt: skip


def scenes() -> list[dict]:
    """Good scenes that use every kind of table."""
    square = [[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1]]
    arrays = {"vertices": square, "triangles": [[0, 1, 2], [1, 3, 2]], "start": square}
    keyframes = [{"time": 0}, {"time": 1, "translation": [0, 1, 0], "rotation": [0, 720, 0]}]
    pins = [{"select": {"vertices": [0]}, "motion": {"keyframes": keyframes, "smooth": True}}]
    tet = {"vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "tets": [[0, 1, 2, 3]]}
    cloth = {"name": "a", "kind": "cloth", "mesh": arrays, "translation": [0, 1, 0], "velocity": [0, 0, 0], "pins": pins}
    cloth |= {"copies": {"counts": [1, 1, 2], "spacing": [0, 0, 2.0]}, "material": {"young_modulus": 1e5, "thickness": 1e-3}}
    solid = {"name": "b", "kind": "solid", "mesh": tet, "translation": [0, 3, 0], "minimum_separation": 1e-4, "friction": 0.3}
    moving = {"velocity": [0, 0.1, 0], "angular_velocity": [0, 1, 0], "start": 0, "end": 1}
    whole = {
        "title": "x",
        "bodies": [cloth, solid],
        "obstacles": [{"name": "f", "mesh": {"shape": "plane"}, "motion": moving}],
        "attachments": [
            {"bodies": ["a[0]", "b"], "pairs": [[0, 1]], "stiffness": 10, "rest_length": 0.1},
            {"bodies": ["b", "f"], "within": 10.0},
        ],
        "forces": [
            {"kind": "wind", "velocity": [1, 0, 0], "bodies": ["a[0]"]},
            {"kind": "vertices", "body": "b", "select": {"nearest": [0, 0, 0]}, "force": [0, 1, 0], "start": 0, "end": 1},
        ],
        "simulation": {
            "time_step": 0.01,
            "steps": 2,
            "substeps": 1,
            "gravity": [0, -9.81, 0],
            "precision": "float64",
            "max_outer": 3,
        },
        "contact": {"method": "barrier", "activation_distance": 1e-3, "minimum_separation": 1e-5, "friction": 0.1},
    }
    shapes = [
        {
            "name": shape,
            "kind": "cloth" if shape in ("grid", "plane") else "solid",
            "mesh": {"shape": shape},
            "translation": [3 * k, 0, 0],
        }
        for k, shape in enumerate(("box", "sphere", "cylinder", "capsule", "torus", "grid"))
    ]
    shapes[0]["mesh"]["cells"] = [1, 2, 1]
    frames = [[[x, y - 20, z] for x, y, z in square] for y in (0.0, 0.1)]
    arrays = {"vertices": frames[0], "triangles": [[0, 1, 2], [1, 3, 2]]}
    deforming = {"name": "d", "mesh": arrays, "motion": {"cache": {"vertices": frames, "times": [0.0, 0.5]}, "start": 0.01}}
    stairs = {"name": "o", "mesh": {"shape": "stairs", "steps": 2}, "translation": [0, -9, 0]}
    return [
        whole,
        {"bodies": shapes, "obstacles": [stairs, deforming]},
    ]


def mesh_files(folder: Path) -> list[Path]:
    """Good meshes in every format, written into the folder."""
    import meshio
    import trimesh

    ball = generators.Sphere(radius=0.5, cells=2).mesh()
    skin = ball.surface()
    cube = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)], dtype=float)
    mixed = meshio.Mesh(
        cube, [("hexahedron", [[0, 1, 4, 3, 6, 7, 10, 9]]), ("tetra", [[1, 2, 5, 8]]), ("quad", [[0, 1, 4, 3]])]
    )
    for name, options in {
        "a.vtk": {}, "b.vtk": {"binary": False}, "a.vtu": {}, "b.vtu": {"binary": False}, "a.mesh": {},
        "a.msh": {"file_format": "gmsh22"}, "b.msh": {"file_format": "gmsh22", "binary": False},
    }.items():  # fmt: skip
        mixed.write(folder / name, **options)
    tets = meshio.Mesh(ball.vertices, [("tetra", ball.tets)])
    for name, options in {
        "c.msh": {"file_format": "gmsh"}, "d.msh": {"file_format": "gmsh", "binary": False}, "e.msh": {"file_format": "ansys"},
    }.items():  # fmt: skip
        tets.write(folder / name, **options)
    surface = trimesh.Trimesh(skin.vertices, skin.triangles, process=False)
    for name in ("a.obj", "a.ply", "a.stl", "a.off", "a.glb"):
        surface.export(folder / name)
    surface.export(folder / "b.ply", encoding="ascii")
    surface.export(folder / "b.stl", file_type="stl_ascii")
    head = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n0 0 0 1 0 0 0 0 1 1 0 1\n"
    (folder / "c.vtk").write_text(head + "POLYGONS 1 4\n3 0 1 2\nTRIANGLE_STRIPS 1 5\n4 0 1 2 3\nLINES 1 3\n2 0 3\n")
    with contextlib.suppress(ImportError):
        import pyvista

        shown = pyvista.PolyData.from_regular_faces(skin.vertices, skin.triangles)
        shown.save(folder / "a.vtp")
        shown.save(folder / "b.vtp", binary=False)
        shown.save(folder / "d.vtk")
        shown.cast_to_unstructured_grid().save(folder / "c.vtu")
    np.savez(folder / "a.npz", V=ball.vertices, T=ball.tets)
    np.savez_compressed(folder / "b.npz", V=ball.vertices, F=ball.triangles)
    np.savez(folder / "c.npz", V=np.stack([skin.vertices, 2 * skin.vertices]), F=skin.triangles, times=[0.0, 1.0])
    nodes = "\n".join(f"{k} {x:.17g} {y:.17g} {z:.17g}" for k, (x, y, z) in enumerate(ball.vertices))
    elements = "\n".join(f"{k} {' '.join(map(str, tet))}" for k, tet in enumerate(ball.tets))
    (folder / "a.node").write_text(f"{len(ball.vertices)} 3 0 0\n{nodes}\n")
    (folder / "a.ele").write_text(f"{len(ball.tets)} 4 0\n{elements}\n")
    with contextlib.suppress(ImportError):
        from pxr import Usd, UsdGeom

        for name in ("a.usda", "a.usdc"):
            stage = Usd.Stage.CreateNew(str(folder / name))
            UsdGeom.SetStageMetersPerUnit(stage, 0.01)
            root = UsdGeom.Xform.Define(stage, "/root")
            root.AddScaleOp().Set((2, 2, 2))
            prim = UsdGeom.Mesh.Define(stage, "/root/m")
            prim.CreatePointsAttr([tuple(map(float, point)) for point in skin.vertices])
            prim.GetPointsAttr().Set([tuple(map(float, 2 * point)) for point in skin.vertices], 5.0)
            prim.CreateFaceVertexCountsAttr([3] * len(skin.triangles))
            prim.CreateFaceVertexIndicesAttr([int(k) for k in skin.triangles.ravel()])
            stage.Save()
    with contextlib.suppress(ImportError):
        write_archive(folder / "a.abc", skin)
    return sorted(folder.iterdir())


def write_archive(path: Path, skin: meshes.Mesh) -> None:
    """An Alembic archive of a mesh that deforms below a place; it is whole once this has ended."""
    import imath  # comes with alembic3d
    from alembic3d import Abc, AbcCoreAbstract, AbcGeom

    def array(kind, values):
        made = kind(len(values))
        np.asarray(made)[:] = values
        return made

    archive = Abc.CreateArchiveWithInfo(str(path), "fuzz", "")
    times = archive.addTimeSampling(AbcCoreAbstract.TimeSampling(0.04, 0.0))
    root = AbcGeom.OXform(archive.getTop(), "root")
    place = AbcGeom.XformSample()
    place.setScale(imath.V3d(2, 2, 2))
    root.getSchema().set(place)
    mesh = AbcGeom.OPolyMesh(root, "m", times).getSchema()
    faces = array(imath.IntArray, skin.triangles[:, ::-1].ravel()), array(imath.IntArray, np.full(len(skin.triangles), 3))
    mesh.set(AbcGeom.OPolyMeshSchemaSample(array(imath.V3fArray, skin.vertices), *faces))
    mesh.set(AbcGeom.OPolyMeshSchemaSample(array(imath.V3fArray, 2 * skin.vertices)))


# --- damage ---


def damaged_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes after a few mutations."""
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        at = int(rng.integers(len(data) + 1))
        to = min(len(data), at + int(rng.integers(1, 1 + max(1, min(200, len(data))))))
        match int(rng.integers(12)):
            case 0:
                data = data[:at]
            case 1:
                data = data[:at] + data[to:]
            case 2:
                data = data[:at] + data[at:to] * int(rng.integers(2, 5)) + data[to:]
            case 3:
                data = data[:at] + rng.bytes(to - at) + data[to:]
            case 4 | 5:
                data = data[:at] + HOSTILE_WORDS[rng.integers(len(HOSTILE_WORDS))] + data[at:]
            case 6 if data:
                flipped = bytearray(data)
                flipped[min(at, len(data) - 1)] ^= 1 << int(rng.integers(8))
                data = bytes(flipped)
            case 8 | 9 | 10:  # a digit for another
                digits = [k for k, byte in enumerate(data[:100_000]) if 48 <= byte < 58]
                if digits:
                    k = digits[rng.integers(len(digits))]
                    data = data[:k] + b"%d" % rng.integers(10) + data[k + 1 :]
            case _:  # a word for another
                words = data.split(b" ")
                words[rng.integers(len(words))] = HOSTILE_WORDS[rng.integers(len(HOSTILE_WORDS))]
                data = b" ".join(words)
    return data


def hostile_value(rng: np.random.Generator, text: bool):
    """A value that is not expected. text: only what JSON can say."""
    values = [
        None, True, "", "x" * 5000, "1", -1, 0, 10**400, 2**64, 2**31, 1e308, 1e-200, 1e-7, float("nan"), float("inf"), [], {}, [[]],
        {"shape": "box"}, {"shape": {}}, [1, 2], [[0, 0, 0]], {"vertices": [[10**400, 0, 0]], "triangles": [[0, 0, 0]]}, "a[0]", "../x.obj",
    ]  # fmt: skip
    if not text:
        loop: list = []
        loop.append(loop)
        deep: object = 0
        for _ in range(2000):
            deep = [deep]
        values += [
            1j, np.array(1.0), np.array([1j]), np.zeros((0, 3)), np.zeros((2, 3)), np.float32(2), np.int8(3), b"x", object(), loop, deep,
            datetime.date(2020, 1, 1), np.array([["a"] * 3]), np.datetime64("2020"), set(), lambda: 0, Path("x.obj"), np.array([[None] * 3]),
            range(3), slice(1), np.ma.masked, np.array([[np.inf] * 3]),
        ]  # fmt: skip
    return values[rng.integers(len(values))]


def damaged_tables(tables, rng: np.random.Generator, text: bool):
    """The tables after a few mutations of their values."""
    tables = copy.deepcopy(tables)
    for _ in range(int(rng.integers(1, 5))):
        places: list[tuple] = []

        def walk(value, places=places) -> None:
            if len(places) < 10_000:
                for key, inner in list(value.items() if isinstance(value, dict) else enumerate(value)):
                    places.append((value, key))
                    if isinstance(inner, dict | list) and inner is not value:
                        walk(inner)

        with contextlib.suppress(RecursionError):
            walk(tables)
        if not places:
            return tables
        holder, key = places[rng.integers(len(places))]
        other, source = places[rng.integers(len(places))]
        match int(rng.integers(6)):
            case 0:
                del holder[key]
            case 1:
                with contextlib.suppress(RecursionError):
                    holder[key] = copy.deepcopy(other[source])  # a value of another place
            case 2:
                holder[key] = [holder[key]]
            case 3 if isinstance(holder, dict):
                holder["key" * int(rng.integers(1, 999))] = holder.pop(key)
            case _:
                holder[key] = hostile_value(rng, text)
    return tables


def toml(value) -> str:
    """A value as TOML, all tables inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(key))} = {toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return '""' if value is None else json.dumps(value).replace("NaN", "nan").replace("Infinity", "inf")


# --- judging ---


class Hang(BaseException):
    """An input took longer than LIMIT."""


def judge_scene(source, rng: np.random.Generator) -> str:
    """Reads and checks a scene, from a file or from tables, and simulates some of the good ones for a step."""
    if isinstance(source, Path):
        findings, _ = check.check_file(source)
        if findings:
            with contextlib.suppress(SceneError):
                pdipc.load_scene(source)
            return "refused"
        scene = pdipc.load_scene(source)
    else:
        scene = pdipc.Scene(**source)
        if check.check(scene):
            return "refused"
    if rng.integers(STEPPED) == 0:
        scene.simulation.substeps = 1
        sim = pdipc.Simulation(scene, "cpu")
        sim.step()
        if not np.isfinite(sim.positions).all():
            return "foreign positions that are not finite"
        if len(pdipc.find_intersections(sim.positions, sim.triangles, sim.model.assembly.obstacle)):
            return "foreign intersections"
        return "simulated"
    return "read"


def judge(
    number: int, seed: int, tables: list[dict], files: list[Path], folder: Path, reader: worker.Worker
) -> tuple[str, str, object]:
    """Kind of input `number`, what came of it, and the input."""
    rng = np.random.default_rng([seed, number])
    kind = ("toml", "json", "python", "mesh", "mesh", "mesh")[number % 6]
    source: object = None
    try:
        if kind == "mesh":
            good = files[rng.integers(len(files))]
            source = folder / f"input{good.suffix}"
            source.write_bytes(damaged_bytes(good.read_bytes(), rng))
            for partner in {".node": [".ele"], ".ele": [".node"]}.get(good.suffix, []):
                source.with_suffix(partner).write_bytes(good.with_suffix(partner).read_bytes())
            kind = good.suffix
            if good.suffix not in CACHES or rng.integers(2):
                meshes.read(source, reader)
            else:
                read_frames(str(source), 25.0 if rng.integers(2) else None, reader)
            return kind, "read", source
        scene = tables[rng.integers(len(tables))]
        if kind == "python":
            source = damaged_tables(scene, rng, text=False)
        else:
            if rng.integers(2):
                scene = damaged_tables(scene, rng, text=True)
            text = (
                json.dumps(scene)
                if kind == "json"
                else "\n".join(f"{json.dumps(str(key))} = {toml(value)}" for key, value in scene.items())
            ).encode()
            source = folder / f"input.{kind}"
            source.write_bytes(damaged_bytes(text, rng) if rng.integers(2) else text)
        return kind, judge_scene(source, rng), source
    except SceneError as error:
        if isinstance(source, Path) and source.stem not in str(error):
            return kind, f"foreign message without the file: {str(error)[:200]!r}", source
        return kind, "refused", source
    except Hang:
        return kind, "hang", source
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return (
            kind,
            f"foreign {type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {str(error)[:100]!r}",
            source,
        )


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    options.add_argument("--inputs", type=int, default=10_000)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--seconds", type=float, default=float("inf"), help="no further input after this time")
    options.add_argument("--keep", type=Path, help="folder for the inputs that were not dealt with")
    results = Path(__file__).resolve().parent / "results"
    options.add_argument("--output", type=Path, default=results / "fuzz.json")
    options.add_argument("--only", type=int, help="the one input of this number, with its traceback")
    given = options.parse_args()
    warnings.simplefilter("ignore")

    def late(*_) -> None:
        raise Hang

    for each in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(each, late)
    counts: collections.Counter = collections.Counter()
    bad: list[str] = []
    git = ["git", "-C", str(results.parent), "rev-parse", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    head = {"machine": machine(), "commit": commit, "seed": given.seed}

    def report() -> None:
        total = {name: sum(count for (_, came), count in counts.items() if came == name) for name in OUTCOMES}
        kinds = {kind: {name: counts[kind, name] for name in OUTCOMES} for kind in sorted({kind for kind, _ in counts})}
        took = {"load": os.getloadavg()[1], "seconds": round(time.monotonic() - begun), "slowest": round(slowest[0], 1)}
        result = head | took | {"inputs": done, **total, "kinds": kinds, "bad": bad[:50]}
        given.output.write_text(json.dumps(result, indent=1) + "\n")

    begun, slowest, done = time.monotonic(), (0.0, 0), 0
    with tempfile.TemporaryDirectory() as good, tempfile.TemporaryDirectory() as made, worker.Worker() as reader:
        tables, files = scenes(), mesh_files(Path(good))
        for source in files:
            meshes.read(source, reader)  # the good ones are good
        for table in tables:
            assert check.check(pdipc.Scene(**table)) == []
            for precision in ("float64", "float32"):  # kernels are compiled here, and not on the time of an input
                compiled = pdipc.Scene(**table)
                compiled.simulation.precision = precision
                with contextlib.suppress(SceneError):  # one of them is too fine for float32
                    pdipc.Simulation(compiled, "cpu").step()
        for number in [given.only] if given.only is not None else range(given.inputs):
            if time.monotonic() - begun > given.seconds:
                break
            signal.setitimer(signal.ITIMER_PROF, LIMIT)
            signal.alarm(10 * LIMIT)
            started = time.monotonic()
            with contextlib.redirect_stdout(io.StringIO()):
                kind, came, source = judge(number, given.seed, tables, files, Path(made), reader)
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
            slowest = max(slowest, (time.monotonic() - started, number))
            done += 1
            counts[kind, came.split()[0]] += 1
            if came.startswith(("foreign", "hang")):
                bad.append(f"input {number} ({kind}): {came}")
                print(bad[-1], flush=True)
                if given.keep:
                    given.keep.mkdir(parents=True, exist_ok=True)
                    data = source.read_bytes() if isinstance(source, Path) else repr(source).encode()
                    (given.keep / f"{number}{source.suffix if isinstance(source, Path) else '.txt'}").write_bytes(data)
            elif given.only is not None:
                print(came)
            if done % 1000 == 0:
                report()
                print(f"{done} inputs, {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    for kind in sorted({kind for kind, _ in counts}):
        print(f"{kind:8}" + "".join(f"{counts[kind, name]:8} {name}" for name in OUTCOMES))
    if given.only is None:
        report()
    print(f"{done} inputs, the slowest {slowest[0]:.1f} s (input {slowest[1]}), {len(bad)} foreign errors or hangs")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
