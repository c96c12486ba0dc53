"""Run by Blender's Python. `make STAGE`: a sheet below a turned and scaled parent, and a cube that turns by two keys, exported as USD with Blender's
own settings. `show STAGE OUT.npz`: what Blender shows of a stage.
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


def make(stage: str) -> None:
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
    bpy.ops.wm.usd_export(filepath=stage, export_animation=True)


def show(stage: str, out: str) -> None:
    bpy.ops.wm.usd_import(filepath=stage)
    shown = {name: np.array([place(name, k) for k in range(1, FRAMES + 1)]) for name in ("Sheet", "Spinner")}
    np.savez(out, **shown, start=bpy.context.scene.frame_start)


bpy.ops.wm.read_factory_settings(use_empty=True)
what, *names = sys.argv[sys.argv.index("--") + 1 :]
{"make": make, "show": show}[what](*names)
