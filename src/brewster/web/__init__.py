"""The front doors in a browser: a page that separates photos, and the study; fastapi is used in this room only."""
