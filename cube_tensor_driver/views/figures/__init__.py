"""Pictures as files. A function takes results and returns a figure of matplotlib."""
