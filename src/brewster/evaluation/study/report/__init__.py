"""The report of a study: rates with intervals and agreement, as tables and files."""
