"""A user study with blind paired comparisons: its files, its answers, and the statistics of the
answers.
"""
