"""Values in place of a scene's own: keys and values as a command line gives them."""

import pytest

from pdipc.scene.errors import SceneError
from pdipc.scene.load import load_scene
from pdipc.scene.vary import parse_setting, put

SCENE = """
[[bodies]]
name = "ball"
kind = "solid"
mesh = { shape = "sphere", radius = 0.1, cells = 3 }
[[bodies]]
name = "a.b"
kind = "cloth"
mesh = { shape = "grid", cells = [2, 2] }
translation = [0, 1, 0]
pins = [{ select = { all = true } }]
"""


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("a.b=1", [1]),
        ("a.b=1e4, 0.3", [1e4, 0.3]),
        ("a.b=[0,-9.81,0],[0,-1.62,0]", [[0, -9.81, 0], [0, -1.62, 0]]),
        ("a.b=true,false", [True, False]),
        ("a.b=global,per_vertex", ["global", "per_vertex"]),
        ('a.b="x,y",z', ["x,y", "z"]),
        ("a.b={x = 1},{x = 2}", [{"x": 1}, {"x": 2}]),
        ("a.b=x=y", ["x=y"]),
    ],
)
def test_values_are_those_of_toml_and_words(text, values):
    assert parse_setting(text) == ("a.b", values)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("friction", "KEY=VALUE"),
        ("=1", "KEY=VALUE"),
        ("a..b=1", "is no key"),
        ("a\nb=1", "is no key"),
        ("a=", "no value"),
        ("a=0.1,0.2,0.1", "0.1 is there twice"),
    ],
)
def test_what_is_no_setting_is_refused(text, said):
    with pytest.raises(SceneError, match=said):
        parse_setting(text)


def test_entries_are_found_by_name_and_by_number(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    values = {
        "contact.friction": 0.3,
        "bodies.ball.material.young_modulus": 1e4,
        'bodies."a.b".pins.0.stiffness': 5.0,
        "bodies.1.translation.1": 2.0,
    }
    scene = load_scene(path, values)
    assert scene.contact.friction == 0.3
    assert scene.bodies[0].material.young_modulus == 1e4
    assert scene.bodies[1].pins[0].stiffness == 5.0
    assert scene.bodies[1].translation == (0, 2, 0)
    assert load_scene(path).bodies[0].material.young_modulus == 1e5  # what was read before is not changed


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("bodies.bell.friction", '"bodies.bell.friction": bodies has no "bell"; there are: ball, a.b'),
        ("bodies.7.friction", 'bodies has no "7"'),
        ("bodies.ball.name.x.y", 'bodies.ball.name is "ball", which has no "x"'),
        ("contact.frictoin", 'contact.frictoin = 1: unknown key; did you mean "friction"'),
        ("bodies.ball.material.poisson_ratio", "less than or equal to 0.499"),
    ],
)
def test_a_key_that_leads_nowhere_is_told(tmp_path, key, said):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    with pytest.raises(SceneError) as caught:
        load_scene(path, {key: 1})
    assert said in str(caught.value) and "scene.toml" in str(caught.value)


def test_tables_are_copied():
    tables = {"contact": {"friction": 0.1}}
    assert put(tables, {"contact.friction": 0.2}) == {"contact": {"friction": 0.2}}
    assert tables == {"contact": {"friction": 0.1}}
