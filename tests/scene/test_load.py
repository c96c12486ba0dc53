"""Scene files: what is wrong is said with file, key, value and what is allowed; what is right survives a round trip."""

import typing

import numpy as np
import pytest

from pdipc.linear.solvers import SOLVERS
from pdipc.scene import reference
from pdipc.scene.assembly import assemble
from pdipc.scene.check import check
from pdipc.scene.errors import SceneError
from pdipc.scene.load import bundled_scenes, load_scene
from pdipc.scene.schema import Arrays, Cloth, ClothMaterial, Scene, Simulation, Solid, uses_newton

GOOD = """
[[bodies]]
name = "ball"
kind = "solid"
mesh = { shape = "sphere", cells = 4 }
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("titel = 'x'", r'titel = "x": unknown key; did you mean "title"\?'),
        ("[simulation]\ntime_step = 0", r"simulation.time_step = 0: must be greater than 0 \(Length h of a step, s"),
        (
            "[simulation]\nlinear_iterations = 10000000000",
            r"linear_iterations = 10000000000: must be less than or equal to 100000",
        ),
        ("[simulation]\nlinear_solver = 'lu'", r'linear_solver = "lu": must be .*pcg'),
        ("[contact]\ntruncation = 'none'", r'contact.truncation = "none": must be .auto., .per_vertex. or .global.'),
        ("[[bodies]]\nname = 'a'\nmesh = 'a.obj'", r'bodies\[1\] \("a"\): needs kind = "solid", "cloth", "rod" or "rigid"$'),
        ("[[forces]]\nvelocity = [1, 0, 0]", r'forces\[0\]: needs kind = "wind" or "vertices"$'),
        ("[[forces]]\nkind = 'wind'\nvelocity = [1, 0, 0]\nbodies = []", r"forces\[0\].bodies = \[\]: .*at least 1 item"),
        ("[[obstacles]]\nname = 'o'\nmesh = 'a.obj'\ntranslation = 'up'", r'translation = "up": must be a list \(Where'),
        ("[[bodies]]\nkind = 'clth'\nmesh = 'a.obj'", r'bodies\[1\].kind = "clth": must be "solid", "cloth", "rod" or "rigid"'),
        (
            "[[bodies]]\nname = 'ball'\nkind = 'cloth'\nmesh = 'a.obj'",
            r'toml": the scene: names must be unique; used more than once: ball$',
        ),
        (
            "[[obstacles]]\nname = 'o'\nmesh = { shape = 'cub' }",
            r'obstacles\[0\] \("o"\).mesh = .*: must be a file path.*"box"',
        ),
        ("[[obstacles]]\nname = 'o'\nmesh = { shape = 'box', sice = 1 }", r'mesh.sice = 1: unknown key; did you mean "size"\?'),
        (
            "[[obstacles]]\nname = 'o'\nmesh = { vertices = [[0, 0]] }",
            r"mesh.vertices = .*has the shape \(1, 2\); must be \(n, 3\)",
        ),
        ("[[obstacles]]\nname = 'o'\nmesh = 'a.obj'\nscale = [1, 2]", r'\("o"\).scale'),
        ("[[obstacles]]\nname = 'o'\nmesh = 'a.obj'\nmotion = { keyframes = [{time = 1}, {time = 0}] }", "order of time"),
        (
            "[[obstacles]]\nname = 'o'\nmesh = 'a.obj'\nmotion = { velocity = [nan, 0, 0] }",
            r"motion.velocity\[0\] = nan: must be a finite",
        ),
        (
            "[[forces]]\nkind = 'wind'\nvelocity = [1, 0, 0]\nstart = 2\nend = 1",
            r"end = 1.0 s must be later than start = 2.0 s",
        ),
        ("[[forces]]\nkind = 'vertices'\nbody = 'ball'\nforce = [1, 0, 0]", r"forces\[0\].select: is missing \(Which vertices"),
        ("[[attachments]]\nbodies = ['ball', 'ball']", "exactly one of pairs, within is needed; given: none"),
        ("a = = 1", r"is not valid TOML: .*line 1"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, message):
    file = tmp_path / "scene.toml"
    file.write_text(text + "\n" + GOOD if text.startswith(("titel", "a =")) else GOOD + text)
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(file)
    assert str(file) in str(caught.value)


def test_everything_wrong_is_said_at_once(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text("titel = 1\n[simulation]\nsteps = -1\nmax_outer = 0\n" + GOOD)
    with pytest.raises(SceneError) as caught:
        load_scene(file)
    assert [key in str(caught.value) for key in ("titel", "simulation.steps", "simulation.max_outer")] == [True] * 3


@pytest.mark.parametrize(
    ("name", "message"), [("cloth_on_spher", 'did you mean "cloth_on_sphere"'), (__file__, "ends in .toml or .json")]
)
def test_no_such_scene(name, message):
    with pytest.raises(SceneError, match=message):
        load_scene(name)


def test_mesh_paths_are_relative_to_the_file(tmp_path):
    np.savez(tmp_path / "one.npz", V=np.eye(4, 3, k=-1), T=[[0, 1, 2, 3]])
    (tmp_path / "scene.toml").write_text('[[bodies]]\nname = "tet"\nkind = "solid"\nmesh = "one.npz"\n')
    scene = load_scene(tmp_path / "scene.toml")
    assert scene.bodies[0].mesh == str(tmp_path / "one.npz")
    assert len(assemble(scene).tets) == 1


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "scene.toml").write_text(GOOD, encoding="utf-8-sig")
    assert load_scene(tmp_path / "scene.toml").bodies[0].name == "ball"


def test_a_scene_survives_json(tmp_path):
    arrays = Arrays(vertices=np.random.default_rng(0).random((3, 3)), triangles=[[0, 1, 2]])
    cloth = Cloth(name="c", mesh=arrays, material=ClothMaterial(young_modulus=3e5, thickness=2e-3))
    scene = Scene(
        bodies=[cloth, Solid(name="s", mesh={"shape": "box"}, scale=(1, 2, 3))], obstacles=[{"name": "o", "mesh": "a.obj"}]
    )
    (tmp_path / "scene.json").write_text(scene.model_dump_json())
    scene.obstacles[0].mesh = str(tmp_path / "a.obj")
    assert load_scene(tmp_path / "scene.json") == scene


def test_a_scene_from_json_is_solved_as_the_one_that_was_written(tmp_path):
    """A run goes on from its scene.json, which names every setting: what is the default there was not chosen."""
    for settings in ({}, {"linear_iterations": 30}, {"nonlinear_solver": "newton"}, {"nonlinear_solver": "local-global"}):
        scene = Scene(bodies=[{"name": "c", "kind": "cloth", "mesh": {"shape": "grid"}}], simulation=settings)
        (tmp_path / "scene.json").write_text(scene.model_dump_json())
        again = load_scene(tmp_path / "scene.json")
        assert uses_newton(again.simulation) == uses_newton(scene.simulation)
        assert check(again) == check(scene) == []


def test_cloth_stiffness_follows_from_young_modulus_and_thickness():
    material = ClothMaterial(young_modulus=1e6, thickness=2e-3, poisson_ratio=0.25)
    assert material.membrane_stiffness == pytest.approx(2e3)
    assert material.bending_stiffness == pytest.approx(1e6 * 2e-3**3 / (12 * (1 - 0.25**2)))
    assert ClothMaterial(membrane_stiffness=50.0, bending_stiffness=0.0).bending_stiffness == 0.0
    with pytest.raises(ValueError, match="contradicts"):
        ClothMaterial(young_modulus=1e6, membrane_stiffness=1.0)


def test_solver_names_are_those_of_the_solvers():
    assert typing.get_args(Simulation.model_fields["linear_solver"].annotation) == ("auto", *SOLVERS)


def test_the_reference_is_up_to_date(request):
    document = request.config.rootpath / "docs" / "scene_format.md"
    assert document.read_text() == reference.markdown(), "run: python -m pdipc.scene.reference > docs/scene_format.md"


def test_the_reference_describes_every_key():
    models = [model for group in reference.SECTIONS.values() for model in group]
    undescribed = [
        f"{model.__name__}.{name}"
        for model in models
        for name, field in model.model_fields.items()
        if not field.description and name not in ("kind", "shape")
    ]
    assert undescribed == []


def test_bundled_scenes_have_a_title_and_a_description():
    for path in bundled_scenes().values():
        scene = load_scene(path)
        assert 10 < len(scene.title) < 60, path
        assert len(scene.description) > 40, path
