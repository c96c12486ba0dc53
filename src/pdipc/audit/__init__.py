"""What is measured of states, steps and runs: energies, momenta, forces."""

from pdipc.audit.energies import Audit as Audit
from pdipc.audit.energies import audit as audit
from pdipc.audit.energies import barrier_forces as barrier_forces
from pdipc.audit.frames import replay as replay
from pdipc.audit.frames import vertex_forces as vertex_forces
