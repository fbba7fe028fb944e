"""Rendered datasets: the store of samples on disk, and the generation of samples with several
processes.
"""
