"""SolverPDIPC by Newton's public interface: motions with closed forms, what is led, what is refused, and never an intersection."""

import numpy as np
import pytest

import pdipc

newton = pytest.importorskip("newton")
import warp as wp  # noqa: E402

from pdipc.newton import SolverPDIPC  # noqa: E402
from pdipc.newton.shapes import Unsupported  # noqa: E402
from pdipc.scene.errors import SceneError  # noqa: E402

G, H = 9.81, 0.01
MU, LAME = 3e4, 5e4  # Pa
I = wp.quat_identity()  # noqa: E741
SINGLE = 1e-6  # relative error that states of float32 may have


def builder():
    return newton.ModelBuilder(gravity=(0.0, 0.0, -G))


def cloth(b, z=1.0, cells=3, **more):
    given = {"tri_ke": 1e3, "tri_ka": 5e2, "tri_kd": 0.0, "edge_ke": 1e-2, "mass": 0.01, **more}
    b.add_cloth_grid(
        pos=wp.vec3(-0.05 * cells, -0.05 * cells, z),
        rot=I,
        vel=wp.vec3(0.0),
        dim_x=cells,
        dim_y=cells,
        cell_x=0.1,
        cell_y=0.1,
        **given,
    )


def block(b, z=0.5, cells=2, **more):
    given = {"density": 1000.0, "k_mu": MU, "k_lambda": LAME, "k_damp": 0.0, **more}
    size = {f"dim_{axis}": cells for axis in "xyz"} | {f"cell_{axis}": 0.1 for axis in "xyz"}
    b.add_soft_grid(pos=wp.vec3(-0.1, -0.1, z), rot=I, vel=wp.vec3(0.0), **size, **given)


def solver_of(b, **options):
    return SolverPDIPC(b.finalize(device="cpu"), **options)


def run(solver, steps, before=lambda k, state: None, h=H):
    """The states after each step."""
    now, after = solver.model.state(), solver.model.state()
    states = []
    for k in range(steps):
        before(k, now)
        solver.step(now, after, None, None, h)
        now, after = after, now
        states.append(now.particle_q.numpy().astype(np.float64).copy())
    return now, states


def intersections(solver, q):
    """Pairs of triangles of particles at q (n, 3), with the obstacles where the solver has them."""
    simulation = solver._now
    x = simulation.positions
    x[: len(q)] = q[solver._particles]
    return len(pdipc.find_intersections(x, simulation.triangles, simulation.model.assembly.obstacle))


def test_what_falls_falls_as_implicit_euler_does():
    b = builder()
    cloth(b)
    block(b)
    solver = solver_of(b)
    start = solver.model.particle_q.numpy().astype(np.float64)
    now, states = run(solver, 10)
    for n, q in enumerate(states, 1):
        np.testing.assert_allclose(q - start, np.tile([0, 0, -G * H * H * n * (n + 1) / 2], (len(start), 1)), atol=2 * SINGLE)
    np.testing.assert_allclose(now.particle_qd.numpy()[:, 2], -G * H * 10, rtol=1e-4)
    assert solver.result.converged


def test_materials_are_those_of_the_elements():
    """Lame's constants of both, and a hinge's energy for its fold: Newton's is ke l theta^2 / 2."""
    b = builder()
    block(b)
    b.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 2.0), rot=I, scale=1.0, vel=wp.vec3(0.0), density=0.3, tri_ke=1e3, tri_ka=5e2, tri_kd=0.0, edge_ke=0.2,
        vertices=[wp.vec3(*v) for v in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0))], indices=[0, 1, 2, 1, 3, 2],
    )  # fmt: skip
    solver = solver_of(b)
    solid, sheet = (body.material for body in solver._made.scene.bodies)
    E, nu = solid.young_modulus, solid.poisson_ratio
    assert E / (2 * (1 + nu)) == pytest.approx(MU) and E * nu / ((1 + nu) * (1 - 2 * nu)) == pytest.approx(LAME)
    Y, nu = sheet.membrane_stiffness, sheet.poisson_ratio
    assert Y / (2 * (1 + nu)) == pytest.approx(1e3) and Y * nu / (1 - nu**2) == pytest.approx(5e2)
    from pdipc.constraints import quadratic_bending

    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=float)
    hinge = quadratic_bending.rest(x, np.array([[0, 1, 2], [1, 3, 2]]), sheet.bending_stiffness)
    theta = 1e-3
    across = np.array([1, 1, 0]) / np.sqrt(2)
    x[3] = 0.5 * (x[1] + x[2]) + np.sqrt(0.5) * (np.cos(theta) * across + np.sin(theta) * np.array([0, 0, 1]))
    (corners,), (weight,) = hinge.vertices, hinge.weight
    (g,) = quadratic_bending.curvature_rows(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]]), hinge.vertices)[0]
    energy = 0.5 * weight * np.sum((g @ x[corners]) ** 2)
    assert energy == pytest.approx(0.2 * np.sqrt(2) * theta**2 / 2, rel=1e-3)


def test_particles_keep_their_masses_and_feel_their_forces():
    """A force F on one particle of a loose sheet for one step: all of the momentum F h, and no more, is there afterwards."""
    b = builder()
    cloth(b, mass=0.02)
    solver = solver_of(b, simulation={"tolerance": 1e-6})

    def push(k, state):
        f = np.zeros((16, 3), dtype=np.float32)
        f[5] = (0.3, 0.0, 0.0)
        state.particle_f.assign(f)

    now, _ = run(solver, 1, push)
    momentum = 0.02 * now.particle_qd.numpy().astype(np.float64).sum(axis=0)
    np.testing.assert_allclose(momentum, [0.3 * H, 0, -16 * 0.02 * G * H], rtol=1e-3, atol=1e-7)


def test_held_particles_stay_and_follow_exactly():
    b = builder()
    cloth(b, fix_left=True)
    solver = solver_of(b)
    held = np.flatnonzero(solver.model.particle_mass.numpy() == 0.0)
    start = solver.model.particle_q.numpy().copy()
    assert len(held) == 4

    def lift(k, state):
        q = state.particle_q.numpy().copy()
        q[held, 2] = start[held, 2] + np.float32(0.01) * max(0, k - 2)
        state.particle_q.assign(q)

    _, states = run(solver, 6, lift)
    np.testing.assert_array_equal(states[1][held], start[held])
    np.testing.assert_allclose(states[-1][held, 2], start[held, 2] + 0.03, atol=SINGLE)
    free = np.setdiff1d(np.arange(16), held)
    assert (states[-1][free, 2] < start[free, 2]).all(), "the rest hangs"
    assert solver.result.lag == 0.0


@pytest.fixture(scope="module")
def squeezed():
    """A block between the floor and a kinematic plate that goes down faster than it can be pressed flat: solver, states, lags, plate."""
    b = builder()
    block(b, z=0.01)
    b.add_ground_plane()
    plate = b.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.3), I), is_kinematic=True, mass=1.0)
    b.add_shape_box(plate, hx=0.3, hy=0.3, hz=0.05)
    solver = solver_of(b)
    lags = []

    def press(k, state):
        q = state.body_q.numpy().copy()
        q[0, 2] = 0.3 - 0.01 * (k + 1)
        state.body_q.assign(q)
        if solver.result:
            lags.append(solver.result.lag)

    now, states = run(solver, 12, press)
    return solver, states, lags, now


def test_a_kinematic_body_presses_and_nothing_intersects(squeezed):
    solver, states, _, now = squeezed
    top = 0.3 - 0.12 - 0.05
    assert states[-1][:, 2].max() <= top + solver.result.lag + 1e-3
    assert states[-1][:, 2].min() > 0.0, "the floor holds"
    assert intersections(solver, states[-1]) == 0
    assert now.body_q.numpy()[0, 2] == pytest.approx(0.18 + solver.result.lag, abs=1e-6)


def test_a_body_that_cannot_go_on_waits_and_says_so():
    """A ball is told to go through a block of steel-like stiffness that stands on the floor: it stays above, and so does body_q."""
    b = builder()
    block(b, z=0.002, k_mu=1e9, k_lambda=1e9)
    b.add_ground_plane()
    ball = b.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.26), I), is_kinematic=True, mass=1.0)
    b.add_shape_sphere(ball, radius=0.05)
    b.add_shape_box(ball, xform=wp.transform(wp.vec3(0.0, 0.0, 0.1), I), hx=0.02, hy=0.02, hz=0.02)
    solver = solver_of(b)

    def through(k, state):
        q = state.body_q.numpy().copy()
        q[0, 2] = -0.1
        state.body_q.assign(q)

    now, states = run(solver, 3, through)
    z = now.body_q.numpy()[0, 2]
    assert solver.result.lag == pytest.approx(z + 0.1, abs=1e-3) and solver.result.lag > 0.25
    assert z - 0.05 > states[-1][:, 2].max() - 0.02, "the ball is on the block"
    assert intersections(solver, states[-1]) == 0


def test_a_reset_and_the_same_steps_give_the_same_bits():
    b = builder()
    cloth(b, z=0.05)
    b.add_ground_plane()
    solver = solver_of(b)
    now, first = run(solver, 8)
    solver.reset(now)
    np.testing.assert_array_equal(now.particle_q.numpy(), solver.model.particle_q.numpy())
    assert not now.particle_qd.numpy().any()
    _, second = run(solver, 8)
    for a, c in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, c)


def test_rebuilding_a_bvh_changes_nothing():
    """Programs for SolverVBD call it; without it Newton's cloth_twist would need a second line changed."""
    b = builder()
    cloth(b, z=0.05)
    solver = solver_of(b)
    now, after = solver.model.state(), solver.model.state()
    solver.rebuild_bvh(now)
    solver.step(now, after, None, None, H)
    np.testing.assert_allclose(after.particle_qd.numpy()[:, 2], -G * H, rtol=1e-5)


def test_a_new_start_is_taken_or_refused():
    b = builder()
    cloth(b, z=0.5)
    block(b, z=0.1)
    solver = solver_of(b)
    now, after = solver.model.state(), solver.model.state()
    solver.step(now, after, None, None, H)
    q, qd = after.particle_q.numpy().copy(), after.particle_qd.numpy().copy()
    q[:16, 2] += 0.3
    qd[:16] = (1.0, 0.0, 0.0)
    now.particle_q.assign(q)
    now.particle_qd.assign(qd)
    solver.step(now, after, None, None, H)
    np.testing.assert_allclose(after.particle_q.numpy()[:16] - q[:16], np.tile([H, 0, -G * H * H], (16, 1)), atol=5 * SINGLE)
    q[:16, 2] = 0.2  # through the block
    now.particle_q.assign(q)
    with pytest.raises(ValueError, match=r"cloth_0.*solid_1|solid_1.*cloth_0"):
        solver.step(now, after, None, None, H)


def test_bodies_may_trade_places_in_a_new_start():
    b = builder()
    cloth(b, z=0.5)
    cloth(b, z=0.9)
    solver = solver_of(b)
    now, after = solver.model.state(), solver.model.state()
    solver.step(now, after, None, None, H)
    q = now.particle_q.numpy().copy()
    now.particle_q.assign(np.concatenate([q[16:], q[:16]]))
    solver.step(now, after, None, None, H)
    assert after.particle_q.numpy()[:, 2].reshape(2, 16).mean(axis=1) == pytest.approx([0.9, 0.5], abs=0.01)


def test_another_time_step_goes_on_where_the_last_ended():
    b = builder()
    block(b, z=1.0)
    solver = solver_of(b)
    now, after = solver.model.state(), solver.model.state()
    z, v, expected = float(now.particle_q.numpy()[:, 2].mean()), 0.0, []
    for h in (0.01, 0.01, 0.004, 0.01):
        solver.step(now, after, None, None, h)
        now, after = after, now
        v -= G * h
        z += v * h
        expected.append((z, float(now.particle_q.numpy()[:, 2].mean())))
    assert all(ours == pytest.approx(exact, abs=3 * SINGLE) for exact, ours in expected)


def test_changes_of_the_model_are_taken_over():
    b = builder()
    cloth(b, z=1.0)
    solver = solver_of(b)
    now, _ = run(solver, 2)
    solver.model.set_gravity((0.0, 0.0, 2.0))
    solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
    after = solver.model.state()
    before = now.particle_qd.numpy()[:, 2].copy()
    solver.step(now, after, None, None, H)
    np.testing.assert_allclose(after.particle_qd.numpy()[:, 2] - before, 2.0 * H, atol=1e-5)


def test_masses_materials_and_pins_of_the_model_are_taken_over_in_flight():
    b = builder()
    cloth(b, z=1.0)
    block(b, z=2.0)
    solver = solver_of(b)
    now, _ = run(solver, 3)
    model, after = solver.model, solver.model.state()
    mass = 2.0 * model.particle_mass.numpy()
    mass[:4] = 0.0
    model.particle_mass.assign(mass)
    table = model.tet_materials.numpy().copy()
    table[:, :2] *= 3.0
    model.tet_materials.assign(table)
    solver.notify_model_changed(newton.ModelFlags.ALL)
    held = now.particle_q.numpy()[:4].copy()
    f = np.zeros((model.particle_count, 3), dtype=np.float32)
    f[16:, 0] = mass[16:]  # 1 m/s^2 for the masses of now
    now.particle_f.assign(f)
    before = now.particle_qd.numpy().copy()
    solver.step(now, after, None, None, H)
    np.testing.assert_array_equal(after.particle_q.numpy()[:4], held)
    gained = after.particle_qd.numpy()[16:] - before[16:]
    np.testing.assert_allclose(gained, np.tile([H, 0, -G * H], (len(gained), 1)), atol=1e-4)
    solid = solver._made.scene.bodies[1].material
    assert solid.young_modulus / (2 * (1 + solid.poisson_ratio)) == pytest.approx(3.0 * MU)


def test_a_change_that_cannot_be_taken_over_changes_nothing():
    """A shape grows through the cloth: refused with its name, and the steps after it are those without it."""
    finals = []
    for refused in (False, True):
        b = builder()
        table = b.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.1), I), is_kinematic=True, mass=1.0)
        b.add_shape_box(table, hx=0.1, hy=0.1, hz=0.1)
        cloth(b, z=0.25, cells=4)
        solver = solver_of(b)
        now, _ = run(solver, 10)
        if refused:
            solver.model.shape_scale.assign(np.array([[0.1, 0.1, 0.3]], dtype=np.float32))
            with pytest.raises(SceneError, match=r'"cloth_0" and obstacle "body_0"'):
                solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
        after = solver.model.state()
        for _ in range(5):
            solver.step(now, after, None, None, H)
            now, after = after, now
        finals.append(now.particle_q.numpy().copy())
    np.testing.assert_array_equal(*finals)


def test_the_two_states_may_be_one():
    finals = []
    for same in (False, True):
        b = builder()
        b.add_ground_plane()
        cloth(b, z=0.02)
        solver = solver_of(b)
        now = solver.model.state()
        after = now if same else solver.model.state()
        for _ in range(8):
            solver.step(now, after, solver.model.control(), None, H)
            now, after = after, now
        finals.append(now.particle_q.numpy().copy())
    np.testing.assert_array_equal(*finals)


def test_time_steps_that_differ_every_time_do_not_fill_the_memory():
    b = builder()
    block(b, z=1.0)
    solver = solver_of(b)
    state, v = solver.model.state(), 0.0
    for k in range(20):
        solver.step(state, state, None, None, H * (1 + 0.01 * k))
        v -= G * H * (1 + 0.01 * k)
    assert state.particle_qd.numpy()[:, 2] == pytest.approx(v, rel=1e-4)
    assert len(solver._simulations) <= 8


MOVING = {
    "plane": lambda b, body: b.add_shape_plane(xform=wp.transform_identity(), body=body, width=0.5, length=0.5),
    "sphere": lambda b, body: b.add_shape_sphere(body, radius=0.1),
    "box": lambda b, body: b.add_shape_box(body, hx=0.1, hy=0.15, hz=0.05),
    "capsule": lambda b, body: b.add_shape_capsule(body, radius=0.06, half_height=0.08),
    "cylinder": lambda b, body: b.add_shape_cylinder(body, radius=0.1, half_height=0.08),
    "cone": lambda b, body: b.add_shape_cone(body, radius=0.15, half_height=0.1),
    "ellipsoid": lambda b, body: b.add_shape_ellipsoid(body, rx=0.15, ry=0.1, rz=0.05),
    "mesh": lambda b, body: b.add_shape_mesh(body, mesh=newton.Mesh.create_box(0.1, 0.1, 0.1)),
    "convex mesh": lambda b, body: b.add_shape_convex_hull(body, mesh=newton.Mesh.create_box(0.1, 0.1, 0.1)),
}


@pytest.mark.parametrize("kind", MOVING)
def test_shapes_of_every_kind_that_rise_and_turn_lift_a_cloth(kind):
    b = builder()
    body = b.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.3), I), is_kinematic=True, mass=1.0)
    MOVING[kind](b, body)
    cloth(b, z=0.46, cells=4)
    solver = solver_of(b)

    def lift(k, state):
        q = state.body_q.numpy().copy()
        q[0] = 0.002 * k, 0.0, 0.3 + 0.01 * k, *wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.05 * k)
        state.body_q.assign(q)

    now, states = run(solver, 20, lift)
    assert intersections(solver, states[-1]) == 0 and solver.result.converged and solver.result.lag == 0.0
    assert now.particle_q.numpy()[:, 2].max() > 0.49, "it would have fallen by 0.2 m"


def dynamic(b):
    cloth(b)
    b.add_shape_sphere(b.add_body(label="ball"), radius=0.1)


def springs(b):
    b.add_particle(wp.vec3(0.0), wp.vec3(0.0), 1.0)
    b.add_particle(wp.vec3(1.0), wp.vec3(0.0), 1.0)
    b.add_spring(0, 1, 1.0, 0.0, 0)


def loose(b):
    cloth(b)
    b.add_particle(wp.vec3(0.0), wp.vec3(0.0), 1.0)


def two_materials(b):
    block(b)
    b.tet_materials[0] = (9e4, 1e4, 0.0)


def skin(b):
    block(b, tri_ke=10.0)


def not_at_rest(b):
    cloth(b)
    b.particle_q[5] = wp.vec3(0.0, 0.0, 1.2)


def sail(b):
    cloth(b, tri_drag=1.0)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda b: None, "no particles"),
        (dynamic, r'body 0 \("ball"\) is dynamic'),
        (springs, "1 springs"),
        (loose, "particle 16 belongs to no tet"),
        (two_materials, "k_mu varies from 30000 to 90000"),
        (skin, "stiffness of its own"),
        (not_at_rest, "not at the rest shape"),
        (sail, "tri_drag"),
    ],
)
def test_what_is_not_supported_is_refused(make, said):
    b = builder()
    make(b)
    with pytest.raises(Unsupported, match=said):
        solver_of(b)


def test_a_start_that_intersects_is_refused_with_names():
    b = builder()
    cloth(b, z=0.6)
    block(b, z=0.5)
    with pytest.raises(SceneError, match="cloth_0"):
        solver_of(b)


def test_what_would_do_nothing_or_go_wrong_is_refused():
    b = builder()
    cloth(b)
    solver = solver_of(b)
    state = solver.model.state()
    with pytest.raises(ValueError, match="dt is 0"):
        solver.step(state, state, None, None, 0.0)
    with wp.ScopedCapture(device="cpu"), pytest.raises(RuntimeError, match="cannot be captured"):
        solver.step(state, state, None, None, H)
    control = solver.model.control()
    control.tri_activations.fill_(1.0)
    with pytest.raises(Unsupported, match="tri_activations"):
        solver.step(state, state, control, None, H)
    control.tri_activations.zero_()
    moving = builder()
    cloth(moving)
    moving.add_shape_sphere(moving.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.3), I), is_kinematic=True), radius=0.1)
    lost = solver_of(moving)
    for nowhere in (np.nan, 0.0):
        state = lost.model.state()
        state.body_q.fill_(wp.transform(wp.vec3(0.0), wp.quat(nowhere, nowhere, nowhere, nowhere)))
        with pytest.raises(ValueError, match=r"body_q\[0\].*no place and turn"):
            lost.step(state, state, None, None, H)
    with pytest.raises(ValueError, match="time_step comes from Newton"):
        SolverPDIPC(solver.model, simulation={"time_step": 0.1})
    with pytest.raises(ValueError, match="float32 of Newton's states"):
        SolverPDIPC(solver.model, contact={"minimum_separation": 1e-9})
    with pytest.warns(UserWarning, match="tri_kd up to 10"):
        cloth(b, z=2.0, tri_kd=10.0)
        solver_of(b)


def test_bodies_of_another_solver_are_followed_where_asked():
    b = builder()
    dynamic(b)
    solver = solver_of(b, follow_bodies=True)

    def move(k, state):
        q = state.body_q.numpy().copy()
        q[0, :3] = (0.5, 0.0, 0.1 * k)
        state.body_q.assign(q)

    run(solver, 3, move)
    assert solver._now.pose("body_0")[0] == pytest.approx([0.5, 0.0, 0.2], abs=1e-6)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_what_flies_so_far_that_float32_cannot_tell_it_apart_is_told_or_kept_apart(precision):
    b = builder()
    for z in (1.0, 1.001):
        cloth(b, z, 2)
    b.particle_qd = [(0.0, 0.0, 1e6)] * len(b.particle_q)
    solver = solver_of(b, simulation={"precision": precision})
    triangles = solver.model.tri_indices.numpy()
    if precision == "float64":
        with pytest.warns(UserWarning, match="from the origin, where states, which are float32, may intersect"):
            run(solver, 1, h=1.0)
    else:
        _, (x,) = run(solver, 1, h=1.0)
        assert not len(pdipc.find_intersections(x, triangles))
