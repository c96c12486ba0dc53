"""Run by Blender's Python. `make STAGE`: a sheet below a turned and scaled parent, and a cube that turns by two keys, exported as USD with Blender's
own settings. `show STAGE OUT.npz`: what Blender shows of a stage. `make_alembic ARCHIVE OUT.npz`: the same scene and more as an Alembic archive, and what
Blender shows of it.
"""

import sys

import bpy
import numpy as np

FRAMES = 12


def place(name: str, frame: int) -> np.ndarray:
    """(n, 3) m: vertices of the object that shows a mesh, in the world."""
    bpy.context.scene.frame_set(frame)
    found = next(each for each in bpy.data.objects if each.type == "MESH" and each.name.startswith(name))
    evaluated = found.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    points = np.array([tuple(evaluated.matrix_world @ vertex.co) for vertex in mesh.vertices])
    evaluated.to_mesh_clear()
    return points


def build() -> None:
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = 30, 1, FRAMES
    bpy.ops.object.empty_add(location=(0.2, 0.1, 1.0), rotation=(0.1, 0.2, 0.3))
    parent = bpy.context.active_object
    parent.name, parent.scale = "Stand", (0.5, 0.5, 0.5)
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=6, y_subdivisions=6, size=2.0)
    sheet = bpy.context.active_object
    sheet.name = sheet.data.name = "Sheet"
    sheet.parent = parent
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(0.2, 0.1, 0.3))
    cube = bpy.context.active_object
    cube.name = cube.data.name = "Spinner"
    for frame, angle in ((1, 0.0), (FRAMES, 2.0)):
        cube.rotation_euler[2] = angle
        cube.keyframe_insert("rotation_euler", frame=frame)


def make(stage: str) -> None:
    build()
    bpy.ops.wm.usd_export(filepath=stage, export_animation=True)


def make_alembic(archive: str, out: str) -> None:
    build()
    bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8, radius=0.4, location=(0, 3, 0))
    bag = bpy.context.active_object
    bag.name = bag.data.name = "Bag"
    bag.shape_key_add(name="Basis")
    key = bag.shape_key_add(name="Bent")
    for point in key.data:
        point.co.z += 0.5 * point.co.x
    for frame, value in ((1, 0.0), (FRAMES, 1.0)):
        key.value = value
        key.keyframe_insert("value", frame=frame)
    bpy.ops.mesh.primitive_cube_add(size=0.3, location=(-2, 1, 0))
    bpy.context.active_object.name = "Mirrored"
    bpy.context.active_object.scale = (-1, 1, 1)
    bpy.ops.object.camera_add()
    bpy.ops.wm.alembic_export(filepath=archive, as_background_job=False)
    names = ("Sheet", "Spinner", "Bag", "Mirrored")
    np.savez(out, **{name: np.array([place(name, k) for k in range(1, FRAMES + 1)]) for name in names})


def show(stage: str, out: str) -> None:
    bpy.ops.wm.usd_import(filepath=stage)
    shown = {name: np.array([place(name, k) for k in range(1, FRAMES + 1)]) for name in ("Sheet", "Spinner")}
    np.savez(out, **shown, start=bpy.context.scene.frame_start)


bpy.ops.wm.read_factory_settings(use_empty=True)
what, *names = sys.argv[sys.argv.index("--") + 1 :]
{"make": make, "show": show, "make_alembic": make_alembic}[what](*names)
