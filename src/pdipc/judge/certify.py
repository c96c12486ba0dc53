"""The certificate of a run: every motion that it committed, replayed by a judge that shares no code with the simulation.

`pdipc run --certify` records where every outer iteration began and ended. Here ipctk's broad phase lists the pairs that could
meet on the way, and its Tight Inclusion CCD (Wang et al. 2021), which misses nothing, accuses those that do. It errs towards
hits, so what it accuses is judged once more in whole numbers (`pdipc.judge.exact`): only what that cannot prove apart is a hit. Where
one is, the pairs accused after it in the same motion are listed as they are.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pdipc.judge.exact import stays_apart_exactly
from pdipc.output.results import Run, RunError

TOLERANCE = 1e-6  # of the judge, in parts of the size of what moves; it errs towards hits
NEAR = 2e-3  # of the size of what moves: smaller gaps are measured


@dataclass(frozen=True)
class Hit:
    """A pair that meets during a motion. what: the pair in words. toi: time of impact in [0, 1] of the motion."""

    step: int
    outer: int
    what: str
    toi: float


@dataclass
class Certificate:
    """The verdict on a run: it holds where `hits` is empty.

    segments: motions replayed. pairs: judged, all motions together. close: those of them that
    only exact arithmetic could tell apart. smallest_gap: m, at the ends of the motions, inf where
    nothing came near. ignored: pairs of bodies in quarantine, which were not judged. seconds: time that it took. judge: the program that decided.
    """

    segments: int = 0
    pairs: int = 0
    close: int = 0
    ignored: int = 0
    hits: list[Hit] = field(default_factory=list)
    smallest_gap: float = float("inf")
    seconds: float = 0.0
    judge: str = ""


def certify(run: Run, progress: Callable[[int, int], None] | None = None) -> Certificate:
    """Replays the recorded motions of `run`, one at a time. Pairs of two obstacles are left out.

    progress: called after each motion with the step that it belongs to and the number of motions so far.

    Raises RunError where the record does not lead without a break from the first frame through every other to the last.
    """
    import ipctk

    began = time.perf_counter()
    certificate = Certificate(judge=f"ipctk {ipctk.__version__}, Tight Inclusion CCD; what it accuses: exact arithmetic")
    used, triangles = np.unique(run.triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3).astype(np.int32)
    rods = triangles[:, 1] == triangles[:, 2]  # segments (a, b, b): to this judge, edges without triangles
    segments, triangles = triangles[rods, :2], triangles[~rods]
    edges = np.concatenate([ipctk.edges(triangles), segments]).astype(np.int32)
    obstacle = run.obstacle[used]
    mesh = ipctk.CollisionMesh(run.positions(0)[used], edges, triangles)
    mesh.can_collide = ipctk.make_vertex_patches_filter(np.where(obstacle, 0, 1 + np.arange(len(used))).astype(np.int32))
    moving = run.positions(0)[~run.scripted] if not run.scripted.all() else run.positions(0)
    size = float(np.linalg.norm(np.ptp(moving, axis=0)))
    near = NEAR * size
    judge = ipctk.TightInclusionCCD(tolerance=TOLERANCE * size, conservative_rescaling=1.0)
    finder = ipctk.AdditiveCCD(conservative_rescaling=0.999)  # names most pairs of a condemned motion a thousand times as fast

    frame_of = {record["step"]: frame for frame, record in enumerate(run.records)}

    def leave_out(candidates, quarantined: list[tuple[int, int]]) -> int:
        """Takes the candidates out whose bodies ignore each other; returns how many."""
        before = len(candidates)
        for kind in ("vv_candidates", "ev_candidates", "ee_candidates", "fv_candidates"):
            listed = list(getattr(candidates, kind))
            vertices = [used[[v for v in each.vertex_ids(edges, triangles) if v >= 0]] for each in listed]
            bodies = [run.topology["body_of_vertex"][each] for each in vertices]
            kept = [each for each, b in zip(listed, bodies, strict=True) if (int(b.min()), int(b.max())) not in quarantined]
            setattr(candidates, kind, kept)
        return before - len(candidates)

    def named(candidate) -> str:
        vertices = used[[vertex for vertex in candidate.vertex_ids(edges, triangles) if vertex >= 0]]
        bodies = dict.fromkeys(run.body_names[body] for body in run.topology["body_of_vertex"][vertices].tolist())
        kind = "an edge and an edge" if isinstance(candidate, ipctk.EdgeEdgeCandidate) else "a vertex and a triangle"
        return f"{kind} of " + " and ".join(f'"{name}"' for name in bodies) + f", vertices {vertices.tolist()}"

    for step, outer, start, end in _connected(run):
        x, x_end = np.asfortranarray(start[used]), np.asfortranarray(end[used])
        candidates = ipctk.Candidates()
        candidates.build(mesh, x, x_end, 0.5 * near, ipctk.LBVH())
        certificate.segments += 1
        if quarantined := run.quarantined(frame_of[step]):
            certificate.ignored += leave_out(candidates, quarantined)
        certificate.pairs += len(candidates)
        if not candidates.is_step_collision_free(mesh, x, x_end, 0.0, judge):
            accused = []
            for i in range(len(candidates)):
                candidate = candidates[i]
                ends = [candidate.dof(at, edges, triangles) for at in (x, x_end)]
                meets, toi = candidate.ccd(*ends, 0.0, 1.0, finder)
                if not meets:
                    meets, toi = candidate.ccd(*ends, 0.0, 1.0, judge)
                if meets:
                    accused.append((toi, i, np.concatenate(ends).reshape(8, 3)))
            if not accused:
                certificate.hits.append(Hit(step, outer, "a pair that the judge does not name", 1.0))
            guilty = False
            for toi, i, points in sorted(accused, key=lambda each: each[:2]):
                kind = "edge_edge" if isinstance(candidates[i], ipctk.EdgeEdgeCandidate) else "vertex_triangle"
                if not guilty and stays_apart_exactly(points, kind, 1.0):
                    certificate.close += 1
                else:
                    guilty = True
                    certificate.hits.append(Hit(step, outer, named(candidates[i]), toi))
        gaps = ipctk.NormalCollisions()
        gaps.build(candidates, mesh, x_end, near)
        certificate.smallest_gap = min(certificate.smallest_gap, gaps.compute_minimum_distance(mesh, x_end) ** 0.5)
        if progress is not None:
            progress(step, certificate.segments)
    certificate.seconds = time.perf_counter() - began
    return certificate


def _connected(run: Run):
    """The recorded motions, each of which begins where the one before ended, by way of every frame."""
    if run.frame_count == 0:
        raise RunError(f"{run.folder} has no frames")
    steps = {record["step"]: frame for frame, record in enumerate(run.records)}
    at, before = run.positions(0), 0
    for step, outer, start, end in run.segments():
        if step != before:
            if before and not np.array_equal(run.positions(steps[before]), at):
                raise RunError(f"{run.folder}: the recorded motions do not lead to the frame of step {before}")
            before = step
        if not np.array_equal(start, at):
            where = f"step {step}, outer iteration {outer}"
            raise RunError(f"{run.folder}: the record is broken at {where}: it does not begin where the last motion ended")
        yield step, outer, start, end
        at = end
    if run.records[-1]["step"] != before:
        raise RunError(
            f"{run.folder}: motions are recorded up to step {before} of {run.records[-1]['step']}; run it with --certify"
        )
    if not np.array_equal(run.positions(-1), at):
        raise RunError(f"{run.folder}: the recorded motions do not lead to the last frame")
