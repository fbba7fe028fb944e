"""Readers and writers of single formats, and the search for damaged pixels."""
