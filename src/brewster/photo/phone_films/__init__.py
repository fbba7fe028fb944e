"""The films that phones record around a photo: where they are, and what the metadata state."""
