"""Generation of rendered sets: the job, its executors (one process, several, a Ray cluster), index and preview."""
