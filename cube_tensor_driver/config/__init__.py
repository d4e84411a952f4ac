"""Files that people write and the program checks: skins, calibrations, tares, load scripts, tables.

Reading never starts anything; all mistakes of a file are reported at once, each with file and key.
"""
