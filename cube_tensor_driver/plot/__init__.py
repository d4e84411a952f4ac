"""Pictures as files, drawn by matplotlib, which no other folder imports.

One module per family of pictures, and `style` with what they share. A drawing function takes
results and returns a figure; computing is done elsewhere, live pictures are in `browser`.
"""
