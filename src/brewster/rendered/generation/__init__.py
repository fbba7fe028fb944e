"""Generation of rendered sets: job, executors (one process, several processes, a Ray cluster), index and preview."""
