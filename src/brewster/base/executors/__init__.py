"""Runs independent tasks of any kind in this process, in several processes, or on a Ray cluster."""
