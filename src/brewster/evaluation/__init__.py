"""Evaluation: scores methods on benchmarks, with confidence intervals, tables and an HTML
report.
"""
