"""What the answers of a study say: rates with intervals, strengths, agreement; as tables, files and a plot."""
