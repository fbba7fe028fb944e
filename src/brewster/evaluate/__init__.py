"""Is it true? Benchmarks, scores with their uncertainty, tables, a page to look at, and ablations."""
