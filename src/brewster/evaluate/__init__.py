"""Evaluation: scores methods on benchmarks, with confidence intervals, tables, an HTML report, and ablation studies."""
