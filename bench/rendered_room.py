"""A room for choosing parameters, not for reported results: path-traced with Blender's Python package.

Two heads of an ape turn, a ring rolls, floor and globe are glossy. 14 cameras for training stand in two arcs of 110
degrees, 4 val cameras between them. `python -m bench.rendered_room FOLDER FRAMES` takes about 100 seconds a frame on
two cores.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

try:
    import bpy
    from mathutils import Vector
except ImportError:
    bpy = None

WIDTH, HEIGHT, FIELD_OF_VIEW = 512, 384, math.radians(55)
SAMPLES = 16
DISTANCE = 3.3  # of the cameras, metres
ARC = 110  # degrees
TEXTURES = {name: f"ShaderNodeTex{name.title()}" for name in ("noise", "brick", "wave", "checker", "voronoi")}


def material(texture, colors, scale, roughness):
    """A material whose colour goes from one of `colors` to the other in a pattern."""
    new = bpy.data.materials.new(texture)
    new.use_nodes = True
    nodes, links = new.node_tree.nodes, new.node_tree.links
    pattern, place, surface = nodes.new(TEXTURES[texture]), nodes.new("ShaderNodeTexCoord"), nodes["Principled BSDF"]
    links.new(place.outputs["Object"], pattern.inputs["Vector"])
    pattern.inputs["Scale"].default_value = scale
    surface.inputs["Roughness"].default_value = roughness
    if texture in ("brick", "checker"):
        for i, color in enumerate(colors):
            pattern.inputs[f"Color{i + 1}"].default_value = (*color, 1)
        links.new(pattern.outputs["Color"], surface.inputs["Base Color"])
    else:
        ramp = nodes.new("ShaderNodeValToRGB")
        for element, color in zip(ramp.color_ramp.elements, colors, strict=True):
            element.color = (*color, 1)
        links.new(pattern.outputs[0], ramp.inputs[0])
        links.new(ramp.outputs[0], surface.inputs["Base Color"])
    return new


def add(shape, surface, *, turned=(0, 0, 0), smooth=False, **at):
    """The object that `shape` makes."""
    shape(**at)
    made = bpy.context.object
    made.data.materials.append(surface)
    made.rotation_euler = turned
    if smooth:
        bpy.ops.object.shade_smooth()
    return made


def head(surface, location, size):
    """The head of an ape, smoothed."""
    made = add(bpy.ops.mesh.primitive_monkey_add, surface, smooth=True, size=size, location=location)
    made.modifiers.new("smooth", "SUBSURF").render_levels = 2
    return made


def look(thing, location, target):
    """Puts a camera or a lamp at `location`, towards `target`."""
    thing.location = location
    thing.rotation_euler = (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()


def lamp(location, size, energy, color):
    """An area light towards the middle of the room."""
    data = bpy.data.lights.new("lamp", "AREA")
    data.size, data.energy, data.color = size, energy, color
    made = bpy.data.objects.new("lamp", data)
    bpy.context.scene.collection.objects.link(made)
    look(made, location, (0, 0, 0.8))


def build():
    """Builds the room; returns the moving objects: two heads and the ring."""
    shapes, quarter = bpy.ops.mesh, math.pi / 2
    add(shapes.primitive_plane_add, material("checker", ((0.5, 0.45, 0.4), (0.2, 0.25, 0.3)), 2.5, 0.3), size=9)
    wall = material("voronoi", ((0.25, 0.3, 0.2), (0.65, 0.65, 0.5)), 3, 0.7)
    add(shapes.primitive_plane_add, wall, turned=(quarter, 0, 0), size=9, location=(0, 2.5, 2))
    wall = material("wave", ((0.5, 0.4, 0.3), (0.35, 0.2, 0.2)), 1.2, 0.6)
    add(shapes.primitive_plane_add, wall, turned=(quarter, 0, quarter), size=9, location=(-3.2, 0, 2))
    for i, (*location, size) in enumerate([(-1.9, 1.6, 0.4, 0.8), (1.6, 1.7, 0.3, 0.6), (2.2, 0.9, 0.5, 1.0)]):
        surface = material("brick", ((0.2 + 0.2 * i, 0.3, 0.5), (0.7, 0.6 - 0.2 * i, 0.3)), 4 + i, 0.4)
        add(shapes.primitive_cube_add, surface, turned=(0, 0, 0.5 * i), size=size, location=location)
    globe = material("noise", ((0.1, 0.2, 0.5), (0.6, 0.7, 0.3)), 4, 0.12)
    add(shapes.primitive_uv_sphere_add, globe, smooth=True, radius=0.35, location=(0.2, 1.5, 0.35))
    lamp((2, -3, 3.4), 1.2, 220, (1, 0.96, 0.9))
    lamp((-2.5, -2.8, 2.8), 1.8, 110, (0.9, 0.94, 1))
    first = head(material("noise", ((0.35, 0.2, 0.1), (0.75, 0.55, 0.35)), 6, 0.45), (-0.8, 0.1, 0.7), 1.1)
    second = head(material("voronoi", ((0.5, 0.1, 0.1), (0.8, 0.6, 0.2)), 5, 0.25), (0.8, -0.1, 0.6), 0.9)
    surface = material("checker", ((0.8, 0.8, 0.7), (0.1, 0.3, 0.2)), 8, 0.3)
    size = {"major_radius": 0.3, "minor_radius": 0.1}
    return first, second, add(shapes.primitive_torus_add, surface, smooth=True, location=(0, -0.5, 0.4), **size)


def move(things, frame):
    """Moves the moving objects to their poses at a frame."""
    first, second, ring = things
    first.rotation_euler = (0, 0, 0.12 * frame)
    second.rotation_euler = (0.1 * frame, 0, -0.3 + 0.05 * frame)
    second.location.z = 0.6 + 0.03 * frame
    ring.location.x = -0.3 + 0.06 * frame
    ring.rotation_euler = (math.pi / 2, 0.2 * frame, 0)


def start():
    """An empty scene, its camera, and the settings of the path tracer."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    data.angle = FIELD_OF_VIEW
    scene.camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(scene.camera)
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[1].default_value = 0.3
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", SAMPLES, True
    scene.cycles.max_bounces, scene.cycles.adaptive_threshold = 3, 0.03
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.render.use_persistent_data = True
    scene.render.image_settings.file_format, scene.render.image_settings.quality = "JPEG", 96
    scene.view_settings.view_transform = "Standard"
    return scene


def render(folder: Path, frames: int):
    """Renders the capture and writes its transforms.json."""
    scene = start()
    things = build()
    step = ARC / 6
    train = [(-ARC / 2 + step * i + 9 * up, (0.8, 1.7)[up], "train") for up in (0, 1) for i in range(7)]
    views = train + [(-46 + 1.5 * step * i, 1.25, "val") for i in range(4)]
    focal = WIDTH / 2 / math.tan(FIELD_OF_VIEW / 2)
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": focal, "fl_y": focal, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    listed = []
    for t in range(frames):
        move(things, t)
        for i, (degrees, height, split) in enumerate(views):
            angle, name = math.radians(degrees), f"images/cam{i:02d}/{t:04d}.jpg"
            look(scene.camera, (DISTANCE * math.sin(angle), -DISTANCE * math.cos(angle), height), (0, 0, 0.75))
            bpy.context.view_layer.update()
            scene.render.filepath = str(folder / name)
            bpy.ops.render.render(write_still=True)
            pose = [list(row) for row in scene.camera.matrix_world]
            at = {"camera": f"cam{i:02d}", "frame": t, "time": t / 30}
            listed.append({"file_path": name, "split": split, "transform_matrix": pose, **at})
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **lens, "fps": 30, "frames": listed}))


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the capture is written")
    parser.add_argument("frames", type=int, help="how many")
    options = parser.parse_args()
    if bpy is None:
        parser.error("Blender's Python package is missing, expected `pip install bpy` in a Python of its version")
    render(options.folder.absolute(), options.frames)


if __name__ == "__main__":
    main()
