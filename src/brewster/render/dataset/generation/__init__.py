"""Generation of rendered datasets: the job, the workers that render its samples, the index and the
preview.
"""
