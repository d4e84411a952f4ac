"""What only developers of the package run: torture, mutations, benchmarks, pictures, lint and docs.

It is part of the repository and never installed.
"""
