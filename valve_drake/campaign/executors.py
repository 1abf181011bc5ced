"""Where trials run: on this machine, or on Dask's workers. Both are executors of concurrent.futures."""

import concurrent.futures
import contextlib
from collections.abc import Iterator

from valve_drake.campaign.trial import break_off
from valve_drake.checks import ConfigError, OperationFailed, require, shown


@contextlib.contextmanager
def executor(backend: str, jobs: int, scheduler: str | None = None) -> Iterator[concurrent.futures.Executor]:
    """jobs: trials at a time, on this machine. scheduler: Dask's address; None: a cluster of its own, here.

    Raises ConfigError: Dask is not installed; OperationFailed: its scheduler does not answer.
    """
    require(1 <= jobs <= 1024, "--jobs", "within 1 and 1024", jobs)
    if scheduler is not None and backend != "dask":
        raise ConfigError("--scheduler goes with --backend dask")
    if backend == "local":
        # A thread waits for each run, which is a process of its own.
        pool = concurrent.futures.ThreadPoolExecutor(jobs)
        try:
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            break_off()
        return
    try:
        import distributed
    except ImportError:
        raise ConfigError("--backend dask needs distributed: pip install 'valve-drake[dask]'") from None
    cluster = None
    try:
        if scheduler is None:
            cluster = distributed.LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address=None)
        client = distributed.Client(scheduler if cluster is None else cluster, timeout=20)
    except Exception as error:  # of its many parts; some say nothing
        if cluster is not None:
            cluster.close()
        where = "a cluster on this machine" if scheduler is None else shown(scheduler)
        words = str(error).splitlines() or [type(error).__name__]
        raise OperationFailed(f"Dask does not answer at {where}: {words[0]}") from None
    try:
        yield client.get_executor(pure=False, retries=0)
    finally:
        client.close()
        if cluster is not None:
            cluster.close()
