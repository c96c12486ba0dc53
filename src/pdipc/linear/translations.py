"""Where a solve starts: every body moved as a whole.

    x = Z C^-1 Z^T b,     C = blockdiag(Z^T A Z) + sum over the body of the contact blocks

Each column of Z is one on the vertices that elasticity holds together and zero elsewhere. A body that is stiffer than what the
iterations of a solver reach keeps hanging in the air otherwise: its common motion is the eigenvector that they reach last. Without
contacts the start moves it exactly. With them it falls short, never too far, since the contact blocks dominate the contact
Hessian.
"""

import functools
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse import csgraph

from pdipc.device import blocks
from pdipc.device.language import kernel
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear.solver import Contact
from pdipc.linear.system import System


class Translations:
    """Launches the start of a solve. count: bodies that are not held."""

    def __init__(self, system: System):
        inside = sp.diags_array(system.free.astype(np.float64))
        component = csgraph.connected_components(inside @ system.matrix @ inside, directed=False)[1]
        vertices = np.flatnonzero(system.free)
        label = np.full(system.count, -1)
        label[vertices] = np.unique(component[vertices], return_inverse=True)[1]
        self.count = int(label.max(initial=-1)) + 1
        z = sp.csr_matrix((np.ones(len(vertices)), (vertices, label[vertices])), shape=(system.count, max(1, self.count)))
        # rows of A nearly add up to zero, and what is left is what moves the body: in double precision
        inertia = np.asarray(z.multiply(system.matrix @ z).sum(axis=0)).ravel()
        members = np.argsort(label, kind="stable")[system.count - len(vertices) :]
        starts = np.searchsorted(label[members], np.arange(self.count + 1))

        self.system, self.sums, self._kernels = system, shared.Sums(system.device, system.count), kernels(system.real)
        device = system.device.warp
        self._label = wp.array(label.astype(np.int32), device=device)
        self._members = wp.array(members.astype(np.int32), device=device)
        self._starts = wp.array(starts.astype(np.int32), device=device)
        self._inertia = wp.array(inertia, dtype=system.real.scalar, device=device)
        self._shift = wp.zeros(max(1, self.count), dtype=system.real.vec3, device=device)

    def start(self, x: wp.array, b: wp.array, contact: Contact | None = None) -> None:
        """Launches x = the start of K x = b; entries that are not free stay as they are."""
        if self.count == 0:
            return
        scalar = contact.scalar if contact is not None else None
        block = contact.diagonal if contact is not None else None
        inputs = [self._starts, self._members, self._inertia, b, scalar, block, self._shift]
        self.sums.launch_groups(self._kernels.find, self.count, inputs)
        self.system.device.launch(self._kernels.move, self.system.count, [self._label, self._shift, x])


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    invert, of_block = shared.functions(real).invert, blocks.total(scalar)

    @kernel(module)
    def find(
        first: int,
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        inertia: wp.array(dtype=scalar),
        b: wp.array(dtype=vec3),
        contact_scalar: wp.array(dtype=scalar),
        contact_block: wp.array(dtype=mat33),
        shift_out: wp.array(dtype=vec3),
    ):
        """shift = C^-1 Z^T b, by one thread for each body on the CPU and one block of threads on CUDA."""
        worker = first + wp.tid()
        body = worker / wp.block_dim()
        force = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        diagonal = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        beside = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        for k in range(starts[body] + worker % wp.block_dim(), starts[body + 1], wp.block_dim()):
            i = members[k]
            force += b[i]
            if contact_scalar:
                diagonal += vec3(contact_scalar[i], contact_scalar[i], contact_scalar[i])
            if contact_block:
                a = contact_block[i]
                diagonal += vec3(a[0, 0], a[1, 1], a[2, 2])
                beside += vec3(a[1, 0], a[2, 0], a[2, 1])
        for k in range(3):
            force[k] = of_block(force[k])
            diagonal[k] = of_block(diagonal[k]) + inertia[body]
            beside[k] = of_block(beside[k])
        if worker % wp.block_dim() == 0:
            c = mat33(
                diagonal[0], beside[0], beside[1],
                beside[0], diagonal[1], beside[2],
                beside[1], beside[2], diagonal[2],
            )  # fmt: skip
            shift_out[body] = invert(c) * force

    @kernel(module)
    def move(first: int, label: wp.array(dtype=wp.int32), shift: wp.array(dtype=vec3), x_out: wp.array(dtype=vec3)):
        i = first + wp.tid()
        if label[i] >= 0:
            x_out[i] = shift[label[i]]

    return SimpleNamespace(find=find, move=move)
