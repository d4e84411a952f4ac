"""The commands bench, torture, pictures, test, lint and docs."""
