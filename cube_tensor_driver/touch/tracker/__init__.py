"""Contact tracker: follows contacts from scan to scan as Hertz contacts fitted to all cubes."""
