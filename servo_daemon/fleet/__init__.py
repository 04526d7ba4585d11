"""Many drives: which captures belong to which, work on a Dask cluster, results that are kept, and what the drives have
in common."""
