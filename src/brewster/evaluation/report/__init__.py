"""Reports of results: tables in Markdown, CSV and LaTeX, an HTML page, and published scores of
other methods.
"""
