"""Who computes the rows of a cohort: this machine, a Dask cluster, SLURM."""
