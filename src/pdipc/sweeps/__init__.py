"""A scene with every combination of some values, each simulated into a run folder of its own, on Dask; and a table of what came of it.

    sweep.json      the values, and which scene each run is of
    0000/, ...      a run folder a combination, in the order in which the last key changes fastest
    table.csv       a line a run: its values and its results, which have the same bits wherever they were computed
    times.csv       a line a run: how long it took, and from which step it went on when it had been stopped

Dask gives the run of a worker that dies to another one, which goes on from the run's last checkpoint. What workers and the caller share is the disk.
"""

from pdipc.sweeps.cases import check_case as check_case
from pdipc.sweeps.cases import combinations as combinations
from pdipc.sweeps.cases import run_case as run_case
from pdipc.sweeps.cluster import Progress as Progress
from pdipc.sweeps.run import run_sweep as run_sweep
from pdipc.sweeps.table import write_table as write_table
