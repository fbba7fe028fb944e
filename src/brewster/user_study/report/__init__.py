"""The report of a study: rates with intervals, strengths and agreement, as tables, files and a plot."""
