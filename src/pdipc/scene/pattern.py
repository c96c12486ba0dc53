"""The rest shape of a garment: flat panels, one triangle for each of the cloth."""

from pathlib import Path

import numpy as np

from pdipc.scene import meshes
from pdipc.scene.errors import SceneError
from pdipc.scene.schema import Arrays, Cloth


def corners_at_rest(cloth: Cloth, triangles: int) -> np.ndarray:
    """(m, 3, 3) m: the corners of each of the m = `triangles` triangles of a cloth in its pattern.

    Raises SceneError where the pattern cannot be read or does not have a triangle of some area for each.
    """
    where, table = f'body "{cloth.name}", rest', cloth.rest
    assert table is not None
    try:
        source = table.mesh
        if table.uv:
            if not isinstance(cloth.mesh, str) or not cloth.mesh.lower().endswith(".obj"):
                raise SceneError("uv needs a cloth whose mesh is an .obj file; give a mesh in place of it")
            points, faces = texture(meshes.locate(cloth.mesh))
        elif isinstance(source, str):
            path = meshes.locate(source)
            mesh = meshes.guarded(path, lambda: meshes.from_contents(meshes.contents(path), f'mesh file "{path}"', whole=True))
            points, faces = mesh.vertices, mesh.triangles
        elif isinstance(source, Arrays):
            mesh = meshes.from_arrays(source.vertices, source.tets, source.triangles, "mesh", drop_unused=False)
            points, faces = mesh.vertices, mesh.triangles
        else:
            mesh = source.mesh().surface()  # pyright: ignore[reportOptionalMemberAccess]  (without uv there is one)
            points, faces = mesh.vertices, mesh.triangles
        if len(faces) != triangles:
            raise SceneError(f"has {len(faces)} triangles; the cloth has {triangles}, and each needs one, in the same order")
        flat = np.flatnonzero(meshes.flat_triangles(points, faces))
        if len(flat):
            raise SceneError(f"{len(flat)} of its triangles have no area, first triangles[{flat[0]}]")
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from error
    return table.scale * points[faces]


def texture(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates (k, 3), flat in z = 0, and triangles (m, 3) of an .obj file. Raises SceneError where not all corners have some."""

    def read() -> tuple[np.ndarray, np.ndarray]:
        points, faces = [], []
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
            key, *values = line.partition("#")[0].split() or [""]
            if key == "vt":
                points.append([float(values[0]), float(values[1]) if len(values) > 1 else 0.0, 0.0])
            elif key == "f":
                named = [value.split("/") for value in values]
                if len(named) != 3:
                    raise SceneError(
                        f'mesh file "{path}": line {number} has a face of {len(named)} corners; a pattern needs triangles'
                    )
                if any(len(part) < 2 or not part[1] for part in named):
                    raise SceneError(f'mesh file "{path}": line {number} has corners without texture coordinates')
                index = [int(part[1]) for part in named]
                faces.append([i - 1 if i > 0 else len(points) + i for i in index])
        triangles = np.array(faces, dtype=np.int64).reshape(-1, 3)
        meshes.check_indices(triangles, len(points), "texture coordinates", f'mesh file "{path}"')
        return np.array(points, dtype=np.float64).reshape(-1, 3), triangles

    return meshes.guarded(path, read)
