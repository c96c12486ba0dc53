"""Run by Blender's Python: opens what was exported and writes what Blender shows. Arguments: the stage, a folder with cloth.mdd and
cloth.obj, the .npz to write.
"""

import sys

import bpy
import numpy as np

stage, folder, out = sys.argv[-3:]


def shown(name: str, frame: int) -> np.ndarray:
    """(n, 3) m: vertices of an object, with its modifiers, in the world."""
    bpy.context.scene.frame_set(frame)
    evaluated = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    found = np.array([tuple(evaluated.matrix_world @ vertex.co) for vertex in mesh.vertices])
    evaluated.to_mesh_clear()
    return found


bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=stage)
sheet = next(each for each in bpy.data.objects if each.type == "MESH" and each.name.startswith("Sheet"))
found = {
    "objects": np.array(sorted(each.name for each in bpy.data.objects)),
    "uvs": np.array([tuple(each.uv) for each in sheet.data.uv_layers[0].data]),
    "polygons": np.array([len(each.vertices) for each in sheet.data.polygons]),
    "stage": np.array([shown(sheet.name, 1001 + k) for k in range(6)]),
    "fps": np.array(bpy.context.scene.render.fps / bpy.context.scene.render.fps_base),
    "range": np.array([bpy.context.scene.frame_start, bpy.context.scene.frame_end]),
}
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps, scene.frame_end = 24, 10
bpy.ops.wm.obj_import(filepath=f"{folder}/sheet.obj")  # y up, as the export writes it
cloth = bpy.context.selected_objects[0]
cache = cloth.modifiers.new("pdipc", "MESH_CACHE")
cache.cache_format, cache.filepath, cache.time_mode, cache.frame_start = "MDD", f"{folder}/sheet.mdd", "TIME", 0.0
found["mdd"] = np.array([shown(cloth.name, k) for k in range(6)])
np.savez(out, **found)
