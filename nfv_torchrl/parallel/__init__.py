"""Work that falls into independent pieces, on several cores or machines, through joblib's backends.

The group ``parallel`` of a recipe names one of these classes. Results do not depend on which, nor on how many workers
there are.
"""

from nfv_torchrl.parallel.clusters import Dask, Ray
from nfv_torchrl.parallel.workers import Joblib, WorkerKilled, Workers

__all__ = ["Dask", "Joblib", "Ray", "WorkerKilled", "Workers"]
