"""Point caches, which move the vertices of a mesh that another program has: MDD and PC2, a file a body, and the mesh that it belongs to.

Both hold the vertices of a body's surface, of a rod those of its tube, in the order of its .obj, in metres with y up, in float32.
"""

from pathlib import Path

import numpy as np

from pdipc.output.results import Run

PC2_HEADER = b"POINTCACHE2\0"


def export_mdd(run: Run, folder: Path) -> Path:
    """NAME.mdd, and NAME.obj with the first frame, of each body. Of LightWave: with the time of each frame, s; big-endian."""
    return _export(
        run, folder, ".mdd", lambda points: np.array([run.frame_count, points], ">i4").tobytes() + _times(run), ">f4"
    )


def export_pc2(run: Run, folder: Path) -> Path:
    """NAME.pc2, and NAME.obj with the first frame, of each body. Samples are frames of the run, from 0 on; little-endian."""

    def header(points: int) -> bytes:
        sampling = np.array([0.0, 1.0], "<f4").tobytes()
        return PC2_HEADER + np.array([1, points], "<i4").tobytes() + sampling + np.array([run.frame_count], "<i4").tobytes()

    return _export(run, folder, ".pc2", header, "<f4")


def _times(run: Run) -> bytes:
    return run.times.astype(">f4").tobytes()


def _export(run: Run, folder: Path, suffix: str, header, kind: str) -> Path:
    names = [_file_name(name) for name in run.body_names]
    if len(set(names)) < len(names):  # names that differ only in what files cannot be called
        names = [f"{number}_{name}" for number, name in enumerate(names)]
    start = run.positions(0)
    files = [open(folder / f"{name}{suffix}", "wb") for name in names]  # noqa: SIM115  (all are open at once)
    try:
        for file, skin in zip(files, run.skins, strict=True):
            file.write(header(len(skin.points(start))))
        for frame in range(run.frame_count):
            positions = run.positions(frame)
            for file, skin in zip(files, run.skins, strict=True):
                file.write(skin.points(positions).astype(kind).tobytes())
    finally:
        for file in files:
            file.close()
    for name, skin in zip(names, run.skins, strict=True):
        lines = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in skin.points(start).tolist()]
        lines += [f"f {a} {b} {c}\n" for a, b, c in (skin.triangles + 1).tolist()]
        (folder / f"{name}.obj").write_text("".join(lines), encoding="utf-8")
    return folder


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_.[] " else "_" for c in name)
