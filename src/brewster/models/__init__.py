"""What can undo the glass? Networks, and the table of models that we ship."""
